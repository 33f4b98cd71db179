"""Shared pieces of scenes that fit parameters: optimisers, Jacobians, Hessians, and checks for torch."""

from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np

import ddg_warp as ddg


def skipped(names) -> list[ddg.Check]:
    """Return skipped checks of fitted quantities where torch is not installed; none where it is."""
    missing = () if find_spec("torch") else names
    return [ddg.Check.skip(name, "needs torch: `pip install ddg-warp[torch]`") for name in missing]


def require_torch(scene: str) -> None:
    """Refuse to build a scene with fitted parameters without torch.

    Raises:
        ValueError: torch is not installed.
    """
    if not find_spec("torch"):
        raise ValueError(f"{scene} is learned when it is built, by torch: `pip install ddg-warp[torch]`")


@contextmanager
def one_thread():
    """Run torch on one thread: on its small tensors here, several threads wait longer than they work."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def minimise(loss, start, iterations: int = 40, tolerance: float = 1e-9):
    """Minimise a loss by L-BFGS with a strong Wolfe line search (Nocedal and Wright, Numerical Optimization, 2006, section 7.2).

    Args:
        loss: function of a tensor like `start`, of order one.
        start: initial guess.
        iterations: largest number of iterations.
        tolerance: tolerance of the change of the loss and of its gradient.

    Returns:
        Minimiser, and the loss at every evaluation.
    """
    import torch

    minimiser, losses = start.clone().requires_grad_(), []
    search = torch.optim.LBFGS(
        [minimiser],
        max_iter=iterations,
        tolerance_grad=tolerance,
        tolerance_change=tolerance,
        line_search_fn="strong_wolfe",
    )

    def closure():
        search.zero_grad()
        value = loss(minimiser)
        value.backward()
        losses.append(value.item())
        return value

    search.step(closure)
    return minimiser.detach(), losses


def jacobian(residuals, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (m,) and the Jacobian (m, n) in one backward pass, with one world a residual.

    Args:
        residuals: function of parameters (worlds, n) that returns residuals (worlds, m).
        at: parameters (n,).
    """
    import torch

    with torch.no_grad():
        count = residuals(torch.tensor(parameters)[None]).shape[1]
    worlds = torch.tensor(np.tile(parameters, (count, 1)), requires_grad=True)
    diagonal = residuals(worlds).diagonal()
    (rows,) = torch.autograd.grad(diagonal.sum(), worlds)
    return diagonal.detach().numpy(), rows.numpy()


def least_squares(
    residuals, start: np.ndarray, iterations: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, list]:
    """Minimise a sum of squares by Levenberg's method (Nocedal and Wright, section 10.3).

    Damping grows tenfold after a step without decrease.

    Args:
        residuals: see `jacobian`.
        start: initial guess (n,).
        iterations: largest number of Jacobians.
        tolerance: relative decrease of the sum of squares at which iterations end.

    Returns:
        Parameters (n,), the Jacobian (m, n) there or one step before, and the residuals of the guess and after every step.
    """
    import torch

    parameters, damping, passed = np.array(start, float), 1e-3, []
    for _ in range(iterations):
        values, rows = jacobian(residuals, parameters)
        passed.append(values)
        normal, square = rows.T @ rows, values @ values
        while damping < 1e6:
            step = np.linalg.solve(
                normal + damping * normal.diagonal().max() * np.eye(len(parameters)), -rows.T @ values
            )
            with torch.no_grad():
                tried = residuals(torch.tensor(parameters + step)[None])[0].numpy()
            if tried @ tried < square:
                break
            damping *= 10.0
        else:
            return parameters, rows, passed
        parameters, damping = parameters + step, 0.1 * damping
        if square - tried @ tried < tolerance * square:
            break
    return parameters, rows, [*passed, tried]


def hessian(losses, parameters, step: float = 1e-3) -> np.ndarray:
    """Return second derivatives (n, n) of a loss by central differences of gradients, all worlds in one batch.

    Args:
        losses: function of parameters (worlds, n) that returns losses (worlds,).
        at: parameters (n,).
        step: difference of every parameter.
    """
    import torch

    displaced = step * torch.eye(len(parameters), dtype=parameters.dtype)
    worlds = torch.cat([parameters + displaced, parameters - displaced]).requires_grad_()
    (gradients,) = torch.autograd.grad(losses(worlds).sum(), worlds)
    forward, backward = gradients.split(len(parameters))
    matrix = ((forward - backward) / (2.0 * step)).numpy()
    return 0.5 * (matrix + matrix.T)
