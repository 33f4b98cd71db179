"""Counters of an integrator, stored with a checkpoint so that a resumed run continues them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ddg_warp.capture_lock import launches


@launches
def counts_of(integrator) -> dict[str, np.ndarray]:
    """Return the counters of an integrator by name, for `repeat`; reads from the device."""
    counts = {name: array.numpy() for name, array in _counters(integrator).items()}
    if (search := _search(integrator)) is not None:
        counts |= {f"search/{name}": array.numpy() for name, array in _paths(search).items()}
        counts["search/room"] = np.array([(pairs.capacity, len(pairs._met)) for pairs in search.lists])
        counts["search/candidates"] = np.array(_candidates(search))
    return counts


def statistics(integrator, counts: Mapping[str, np.ndarray]) -> dict:
    """Return `integrator.statistics()` of the whole run, of an integrator resumed from `counts`."""
    result = integrator.statistics()
    if "contact" in result and result["contact"]["searches"] == counts.get("contact/searches"):
        result["contact"]["candidates"] = int(counts["search/candidates"])  # of the last search, before the checkpoint
    return result


@launches
def repeat(integrator, state, dt: float, counts: Mapping[str, np.ndarray]):
    """Set the counters of a new integrator; return `state` in its buffers, for a first step of dt [s].

    Contact candidates are searched again for the motion of the last search and with the same capacity. Later searches then happen as
    in an uninterrupted run.

    Raises:
        ValueError: The counts are of another model.
    """
    integrator._prepare(dt, state)  # may rebuild steppers
    first = integrator._buffers[integrator._own(state)].state  # tests for overlaps
    search, counters = _search(integrator), _counters(integrator)
    motion = {} if search is None else _paths(search)
    wanted = {name: array.shape for name, array in counters.items()} | {
        f"search/{name}": array.numpy().shape for name, array in motion.items()
    }
    if search is not None:
        wanted["search/room"] = (len(search.lists), 2)
    if {name: np.shape(counts.get(name)) for name in wanted} != wanted:
        raise ValueError("the counts are of another model or another integrator; resume with the scene's own")
    if search is not None:
        _search_again(search, motion, counts)
        integrator._coupled.newton.contact.terms.fit()
    for name, array in counters.items():
        array.assign(counts[name])
    return first


def _search_again(search, motion: Mapping, counts: Mapping[str, np.ndarray]) -> None:
    """Repeat the last candidate search before a checkpoint."""
    import warp as wp

    for pairs, (room, hit_capacity) in zip(search.lists, counts["search/room"].tolist(), strict=True):
        if (room, hit_capacity) != (pairs.capacity, len(pairs._met)):
            pairs.reserve(max(room, pairs.capacity), max(hit_capacity, len(pairs._met)))
            search.version += 1
    begin, end = (counts[f"search/{name}"] for name in motion)
    for name, array in motion.items():
        array.assign(counts[f"search/{name}"])
    start = wp.clone(motion["start"])
    search.search(start, wp.array(end - begin, dtype=start.dtype, device=search.device))
    search.fit(start)
    for name, array in motion.items():
        array.assign(counts[f"search/{name}"])


def _counters(integrator) -> dict:
    """Return the counter arrays of an integrator by name."""
    result = {}
    for k, part in enumerate(integrator._parts):
        result |= {f"{k}/outcomes": part.tally, f"{k}/work": part.work}
        if hasattr(part.newton, "pcg_work"):
            result[f"{k}/pcg"] = part.newton.pcg_work
    if (search := _search(integrator)) is not None:
        contact = integrator._coupled.newton.contact
        tally = contact.tally
        result |= {
            "contact/crossed": tally.crossed,
            "contact/least": tally.least,
            "contact/searches": search.counters.searches,
        }
        result |= {"contact/counts": tally.counts, "contact/friction_work": tally.work}
    return result


def _search(integrator):
    """Return the broad phase of the integrator, or None."""
    contact = integrator._coupled.newton.contact if integrator._coupled is not None else None
    return contact.search if contact else None


def _candidates(search) -> int:
    return sum(int(pairs.count.numpy()[0]) for pairs in search.lists)


def _paths(search) -> dict:
    """Return start and end of the motion that candidates were searched for, by name."""
    return {"start": search.validity.start, "end": search.validity.end}
