"""Scene description: rods, shells, joints, supports, loads, materials, motions, contact."""
