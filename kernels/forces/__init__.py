"""Forces beside elements: drag, follower loads, control loads, prescribed motion, gyroscopic couples."""
