"""Non-elastic forces: drag, follower loads, control loads, prescribed motion, gyroscopic couples."""
