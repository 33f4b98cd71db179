"""What is asked of a state: energies, reactions, stresses, fields, modes."""
