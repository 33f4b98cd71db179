"""Episodes, data sets, parameter sweeps and recordings for learning."""
