"""Non-elastic forces as launches of a step: drag, loads, control loads, prescribed motion, gyroscopic couples."""
