"""What an integrator has counted, as arrays to be kept with a checkpoint, so that a resumed run goes on counting."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ddg_warp.threads import launches


@launches
def counts_of(integrator) -> dict[str, np.ndarray]:
    """Counts of an integrator after its last step, by name, from which `go_on` goes on. Reads from the device."""
    found = {name: array.numpy() for name, array in _counters(integrator).items()}
    if (search := _search(integrator)) is not None:
        found |= {f"search/{name}": array.numpy() for name, array in _ways(search).items()}
        found["search/room"] = np.array([(pairs.capacity, len(pairs._met)) for pairs in search.lists])
        found["search/candidates"] = np.array(_candidates(search))
    return found


def statistics(integrator, counts: Mapping[str, np.ndarray]) -> dict:
    """`integrator.statistics()` of one that went on from `counts`, of the whole run."""
    found = integrator.statistics()
    if "contact" in found and found["contact"]["searches"] == counts.get("contact/searches"):
        found["contact"]["candidates"] = int(counts["search/candidates"])  # of the last search, which was before
    return found


@launches
def go_on(integrator, state, dt: float, counts: Mapping[str, np.ndarray]):
    """Has a new integrator count on from `counts`; returns `state` as its own, from which it takes its first step, of dt [s].

    Candidates for contact are found where the run found them last, with as much room: the next searches then come when they would have
    come without a break.

    Raises:
        ValueError: The counts are of another model.
    """
    integrator._prepare(dt, state)  # may make parts anew
    own = integrator._buffers[integrator._own(state)].state  # looks for overlaps
    search, counters = _search(integrator), _counters(integrator)
    ways = {} if search is None else _ways(search)
    wanted = {name: array.shape for name, array in counters.items()} | {
        f"search/{name}": array.numpy().shape for name, array in ways.items()
    }
    if search is not None:
        wanted["search/room"] = (len(search.lists), 2)
    if {name: np.shape(counts.get(name)) for name in wanted} != wanted:
        raise ValueError("the counts are of another model or another integrator; resume with the scene's own")
    if search is not None:
        _search_again(search, ways, counts)
        integrator._net.newton.contact.terms.fit()
    for name, array in counters.items():
        array.assign(counts[name])
    return own


def _search_again(search, ways: Mapping, counts: Mapping[str, np.ndarray]) -> None:
    """Finds the candidates of the last search before a checkpoint."""
    import warp as wp

    for pairs, (room, met) in zip(search.lists, counts["search/room"].tolist(), strict=True):
        if (room, met) != (pairs.capacity, len(pairs._met)):
            pairs.reserve(max(room, pairs.capacity), max(met, len(pairs._met)))
            search.version += 1
    begin, end = (counts[f"search/{name}"] for name in ways)
    for name, array in ways.items():
        array.assign(counts[f"search/{name}"])
    start = wp.clone(ways["start"])
    search.search(start, wp.array(end - begin, dtype=start.dtype, device=search.device))
    search.fit(start)
    for name, array in ways.items():
        array.assign(counts[f"search/{name}"])


def _counters(integrator) -> dict:
    """The arrays in which an integrator counts, by name."""
    found = {}
    for k, part in enumerate(integrator._parts):
        found |= {f"{k}/outcomes": part.tally, f"{k}/work": part.work}
        if hasattr(part.newton, "pcg_work"):
            found[f"{k}/pcg"] = part.newton.pcg_work
    if (search := _search(integrator)) is not None:
        contact = integrator._net.newton.contact
        tally = contact.tally
        found |= {
            "contact/crossed": contact.crossed,
            "contact/least": contact.least,
            "contact/searches": search.searches,
        }
        found |= {"contact/counts": tally.counts, "contact/friction_work": tally.work}
    return found


def _search(integrator):
    """The search for pairs in contact, or None."""
    contact = integrator._net.newton.contact if integrator._net is not None else None
    return contact.search if contact else None


def _candidates(search) -> int:
    return sum(int(pairs.count.numpy()[0]) for pairs in search.lists)


def _ways(search) -> dict:
    """Where the motions began and ended that candidates were found for, by name."""
    return {"start": search._start, "end": search._end}
