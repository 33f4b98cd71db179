"""Vector-Jacobian products of steps and equilibria: from gradients by results to gradients by inputs."""
