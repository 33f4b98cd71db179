"""User-defined forces for the table of effects: springs to the origin, and bonds between pairs of nodes."""

from functools import cache
from typing import Any

import warp as wp


@cache
def spring(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(x: V, v: V, t: real, p: Any):
        return -p.stiffness * x * p.strength

    return force


@cache
def stiffer_spring(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(x: V, v: V, t: real, p: Any):
        return -real(2.0) * p.stiffness * x

    return force


@cache
def spring_energy(real):
    V = wp.types.vector(3, real)

    @wp.func
    def energy(x: V, v: V, t: real, p: Any):
        return real(0.5) * p.stiffness * p.strength * wp.dot(x, x)

    return energy


@cache
def bond(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        return d * (p.stiffness * q.strength)

    return force


@cache
def stiffer_bond(real):
    V = wp.types.vector(3, real)

    @wp.func
    def force(d: V, p: Any, q: Any):
        return d * (p.stiffness + q.stiffness)

    return force


@cache
def bond_energy(real):
    V = wp.types.vector(3, real)

    @wp.func
    def energy(d: V, p: Any, q: Any):
        return real(0.5) * p.stiffness * q.strength * wp.dot(d, d)

    return energy
