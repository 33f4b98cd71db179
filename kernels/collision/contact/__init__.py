"""Contact potentials of collision pairs, their derivatives and sums."""
