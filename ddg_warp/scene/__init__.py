"""What a user describes: rods, shells, joints, supports, loads, materials, motions."""
