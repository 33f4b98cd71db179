"""A run with contact, and the content of movies, for tests."""

import numpy as np

import ddg_warp as ddg


def fallen(device="cpu"):
    """Return the model of a rod that falls on a floor, and five states 0.03 s apart."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    points = np.linspace((-0.2, -0.2, 0.06), (0.2, 0.2, 0.06), 9)
    scene.add_rod(points, section=ddg.Circle(0.02), material=ddg.Material(1e6, density=1000.0), name="rod")
    scene.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    scene.contact(range=5e-3)
    model = scene.build(device)
    integrator, states = ddg.Integrator(model), [model.state()]
    for _ in range(4):
        states.append(integrator.step(states[-1].copy(), 0.03))
    return model, [state.copy() for state in states]


def content(path) -> tuple[float, np.ndarray]:
    """Return frames a second and the frames of a movie, shape (frames, height, width, 3)."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return about["fps"], np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])
