"""What scenes that learn share: a quasi-Newton search, error bars, and what is said where torch is missing."""

from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np

import ddg_warp as ddg


def skipped(names) -> list[ddg.Check]:
    """Checks of what is learned, skipped where torch is not installed; none where it is."""
    missing = () if find_spec("torch") else names
    return [ddg.Check.skip(name, "needs torch: `pip install ddg-warp[torch]`") for name in missing]


def require_torch(scene: str) -> None:
    """Refuse to build a scene of what is learned where torch is not installed.

    Raises:
        ValueError: it is not.
    """
    if not find_spec("torch"):
        raise ValueError(f"{scene} is learned when it is built, by torch: `pip install ddg-warp[torch]`")


@contextmanager
def one_thread():
    """Have torch work on one thread: its tensors are small here, and others would wait for each other longer than they work."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def minimise(loss, start, iterations: int = 40, tolerance: float = 1e-9):
    """L-BFGS with a strong Wolfe line search (Nocedal and Wright, Numerical Optimization, 2006, section 7.2).

    Args:
        loss: of a tensor like `start`; of order one.
        start: the first guess.
        iterations: at most.
        tolerance: of the change of the loss, and of its gradient, at which it ends.

    Returns:
        The tensor found, and the loss at every evaluation.
    """
    import torch

    found, losses = start.clone().requires_grad_(), []
    search = torch.optim.LBFGS(
        [found],
        max_iter=iterations,
        tolerance_grad=tolerance,
        tolerance_change=tolerance,
        line_search_fn="strong_wolfe",
    )

    def closure():
        search.zero_grad()
        value = loss(found)
        value.backward()
        losses.append(value.item())
        return value

    search.step(closure)
    return found.detach(), losses


def jacobian(residuals, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (m,) and their derivatives (m, n) by n numbers, in one backward pass: every residual has a world of its own.

    Args:
        residuals: of numbers (worlds, n), those of every world (worlds, m).
        at: where (n,).
    """
    import torch

    with torch.no_grad():
        count = residuals(torch.tensor(at)[None]).shape[1]
    worlds = torch.tensor(np.tile(at, (count, 1)), requires_grad=True)
    own = residuals(worlds).diagonal()
    (rows,) = torch.autograd.grad(own.sum(), worlds)
    return own.detach().numpy(), rows.numpy()


def least_squares(
    residuals, start: np.ndarray, iterations: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, list]:
    """Levenberg's method (Nocedal and Wright, section 10.3): damping grows tenfold where a step is no gain.

    Args:
        residuals: as of `jacobian`.
        start: the first guess (n,).
        iterations: Jacobians at most.
        tolerance: of the relative gain in the sum of squares, at which it ends.

    Returns:
        The numbers found (n,), the Jacobian there or one step before (m, n), and the residuals after every step, the guess's first.
    """
    import torch

    at, damping, passed = np.array(start, float), 1e-3, []
    for _ in range(iterations):
        found, rows = jacobian(residuals, at)
        passed.append(found)
        normal, now = rows.T @ rows, found @ found
        while damping < 1e6:
            step = np.linalg.solve(normal + damping * normal.diagonal().max() * np.eye(len(at)), -rows.T @ found)
            with torch.no_grad():
                tried = residuals(torch.tensor(at + step)[None])[0].numpy()
            if tried @ tried < now:
                break
            damping *= 10.0
        else:
            return at, rows, passed
        at, damping = at + step, 0.1 * damping
        if now - tried @ tried < tolerance * now:
            break
    return at, rows, [*passed, tried]


def hessian(losses, at, step: float = 1e-3) -> np.ndarray:
    """Second derivatives (n, n) of a loss by n numbers: central differences of its gradients, all of them worlds of one batch.

    Args:
        losses: of numbers (worlds, n), the loss of every world (worlds,).
        at: where (n,).
        step: of every number.
    """
    import torch

    displaced = step * torch.eye(len(at), dtype=at.dtype)
    worlds = torch.cat([at + displaced, at - displaced]).requires_grad_()
    (gradients,) = torch.autograd.grad(losses(worlds).sum(), worlds)
    ahead, back = gradients.split(len(at))
    found = ((ahead - back) / (2.0 * step)).numpy()
    return 0.5 * (found + found.T)
