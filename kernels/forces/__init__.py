"""Forces other than elastic ones: drag, follower loads, control loads, prescribed motion, gyroscopic couples."""
