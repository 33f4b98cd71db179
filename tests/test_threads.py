"""Concurrent threads with separate models or states give sequential results, bit by bit."""

import subprocess
import sys
import threading

import numpy as np
import pytest

SCRIPT = """
import sys, threading
import numpy as np
import pytest
import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.stability import spectrum

def scene(number):
    s = ddg.Scene()
    points = np.zeros((10 + number, 3))
    points[:, 0] = np.linspace(0.0, 1.0, len(points))
    material = ddg.Material(1e7)
    if number % 2:
        sheet = s.add_shell(*meshes.rectangle(3, 3), thickness=0.05, material=material, bending="hinge")
        s.clamp_boundary(sheet, [0, 1, 2, 3])
    else:
        s.clamp(s.add_rod(points, section=ddg.Circle(0.02), material=material))
    return s

def run(number, found):
    model = scene(number).build(sys.argv[1], "float64")
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(20):
        state = integrator.step(state, 0.01)
    rest = statics.solve(model)
    found[number] = state.points(), rest.points(), spectrum(model, rest, 2).eigenvalues, model.energies(state)["kinetic"]

together, alone = {}, {}
threads = [threading.Thread(target=run, args=(number, together)) for number in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
for number in range(4):
    run(number, alone)
for number in range(4):
    for one, other in zip(together[number], alone[number], strict=True):
        assert np.allclose(one, other, rtol=0.0 if sys.argv[1] == "cpu" else 1e-6), number
print("alike")
"""


def test_threads_with_separate_models(device):
    """Threads start in a fresh process, before anything is loaded."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, device], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("alike\n"), done.stderr[-2000:]


def test_capture_waits_for_launches():
    from ddg_warp.capture_lock import capturing, launches

    inside, events, release = threading.Event(), [], threading.Event()

    @launches
    def launch():
        inside.set()
        release.wait()
        events.append("launched")

    def capture():
        with capturing():
            events.append("captured")

    threads = [threading.Thread(target=launch), threading.Thread(target=capture)]
    threads[0].start()
    inside.wait()
    threads[1].start()
    release.set()
    for thread in threads:
        thread.join()
    assert events == ["launched", "captured"]
    with np.testing.assert_raises(ZeroDivisionError), capturing():
        raise ZeroDivisionError
    launch()  # the failure inside released the lock
    capture()


@pytest.mark.parametrize("shared", [False, True])
def test_launches_are_exclusive_on_a_shared_stream(monkeypatch, shared):
    """The second of two launching threads waits for the first on a shared stream, and overlaps it elsewhere."""
    from ddg_warp import capture_lock as threads

    monkeypatch.setattr(threads._serialise, "shared", shared)
    inside, overlapped, release = threading.Event(), threading.Event(), threading.Event()

    @threads.launches
    def first():
        inside.set()
        release.wait()

    @threads.launches
    def second():
        overlapped.set()

    both = [threading.Thread(target=first), threading.Thread(target=second)]
    both[0].start()
    inside.wait()
    both[1].start()
    assert overlapped.wait(None if not shared else 0.2) is not shared
    release.set()
    for thread in both:
        thread.join()
    assert overlapped.is_set()


SHARED = """
import sys, threading
import numpy as np
import ddg_warp as ddg

scene = ddg.Scene()
points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 12)
for number in range(2):
    scene.clamp(scene.add_rod(points + [0.0, 0.1 * number, 0.0], section=ddg.Circle(0.005), material=ddg.Material(1e7)))
scene.contact()
model = scene.build(sys.argv[1], "float64")
integrator = ddg.Integrator(model)

def run(number, found):
    state = model.state(velocities=np.tile([0.0, 0.0, 0.3 * number], (24, 1)))
    for step in range(30):
        state = integrator.step(state, 0.01)
        found.append((state.points(), len(model.contacts(state).gap)))

alone, together = ([[] for _ in range(3)] for _ in range(2))
threads = [threading.Thread(target=run, args=(number, together[number])) for number in range(3)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
for number in range(3):
    run(number, alone[number])
    assert len(alone[number]) == len(together[number]) == 30
    for one, other in zip(alone[number], together[number], strict=True):
        assert np.allclose(one[0], other[0], rtol=0.0, atol=0.0 if sys.argv[1] == "cpu" else 1e-9) and one[1] == other[1]
print("alike")
"""


def test_one_integrator_serves_several_threads(device):
    """Threads have separate states: every step and contact query equals that of a single thread."""
    done = subprocess.run([sys.executable, "-c", SHARED, device], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("alike\n"), done.stderr[-2000:]
