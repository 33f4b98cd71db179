"""Launch configuration, dof maps, island state, outcomes, prefix sums and vectorised access."""
