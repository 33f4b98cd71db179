"""Element path: energies, gradients and factors of elements, frames and parallel transport."""
