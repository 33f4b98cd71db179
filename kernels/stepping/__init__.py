"""Begin and end of steps: predictors, warm starts, substeps, energy drift, resets."""
