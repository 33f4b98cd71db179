"""Post-processing of states: energies, reactions, stresses, fields, modes."""
