"""Fields: parameters of rods that a user prescribes over time, arc length or position."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.typing import Floats, Numbers, Selection

OVER = ("time", "arc_length", "position")
FORMS = ("metric", "curvature", "angle")  # of shells


@argument_checks.called
@dataclass(frozen=True, eq=False)
class Samples:
    """Piecewise linear function of time, arc length, or both, from samples; constant beyond the first and the last.

    A function of time for motions, amplitudes, flows and magnetic fields, and of fields (`Scene.prescribe`) over "time" or
    "arc_length".

    Attributes:
        values: samples (times, ...), (arc lengths,) or (times, arc lengths).
        times: ascending times of the samples (times,) [s]; None for values constant in time.
        arc_lengths: ascending arc lengths of the samples [m]; None for values that are uniform.

    Raises:
        SceneError: values do not fit times and arc lengths or are not finite, or times or arc lengths do not ascend.
    """

    values: Numbers
    times: Numbers | None = None
    arc_lengths: Numbers | None = None

    def __post_init__(self):
        expected = ()
        for name in ("times", "arc_lengths"):
            if getattr(self, name) is not None:
                axis = argument_checks.array(f"Samples: {name}", getattr(self, name), "give ascending numbers").copy()
                if axis.ndim != 1 or not axis.size or not np.isfinite(axis).all() or (np.diff(axis) <= 0.0).any():
                    raise SceneError(f"Samples: {name} are {argument_checks.shown(axis)}; give ascending numbers")
                object.__setattr__(self, name, axis)
                expected += axis.shape
        if not expected:
            raise SceneError("Samples: there are no times and no arc_lengths; give one of them")
        values = argument_checks.array("Samples: values", self.values, f"give numbers of shape {expected}").copy()
        surplus = self.arc_lengths is not None and values.ndim > len(expected)
        if values.shape[: len(expected)] != expected or surplus:
            raise SceneError(f"Samples: values have shape {values.shape}; give {expected}")
        if not np.isfinite(values).all():
            raise SceneError("Samples: values are not all finite; give finite numbers")
        object.__setattr__(self, "values", values)

    def __call__(self, *where: float | Floats) -> Floats:
        """Return the value at t, or at (s, t) with arc lengths."""
        values, t = self.values, where[-1]
        if self.times is not None:
            position = np.interp(t, self.times, np.arange(len(self.times)))
            first = min(int(position), max(0, len(self.times) - 2))
            last = min(first + 1, len(self.times) - 1)
            values = values[first] + (position - first) * (values[last] - values[first])
        return values if self.arc_lengths is None else np.interp(where[0], self.arc_lengths, values)


@dataclass(frozen=True, eq=False)
class Field:
    """Value that a user prescribes: a constant, or a function of time, which in statics is the load parameter.

    Attributes:
        label: name in messages.
        source: the constant, or the function.
        columns: number of components of a vector, 0 for one number, None for any shape.
    """

    label: str
    source: object
    columns: int | None = 0

    @property
    def constant(self) -> bool:
        """True if the value does not depend on time."""
        return not callable(self.source)

    def at(self, t: float, factor: float = 1.0, error=SolverError, arguments: tuple = ()) -> np.ndarray:
        """Return the value at a time; a constant is multiplied by `factor`.

        Args:
            arguments: arguments of the function before the time.

        Raises:
            SolverError: the function failed, or its value is not finite or of another shape; names function and time.
        """
        if self.constant:
            return factor * np.asarray(self.source, float)
        return argument_checks.value_at(self.label, self.source, t, self.columns, error, arguments)


@dataclass(frozen=True, eq=False)
class PrescribedParameter:
    """Rest strain of some rods, or rest form of a shell, that a `Field` prescribes; see `Scene.prescribe`.

    Attributes:
        name: name of the field; parameter: "term.parameter", or the name of a form.
        rods: indices of the rods (R,), none of a shell.
        over: arguments of a function: "time", "arc_length" or "position".
        shell: index of the shell; None for rods.
    """

    name: str
    parameter: str
    rods: np.ndarray
    field: Field
    over: str
    shell: int | None = None


@argument_checks.called
@dataclass(kw_only=True, repr=False, eq=False)
class Fields:
    """Fields of a scene."""

    fields: list[PrescribedParameter] = field(default_factory=list, init=False)

    def prescribe(
        self,
        name: str,
        parameter: str,
        values: Numbers | Callable[[float], Numbers] | Callable[[Floats, float], Numbers] = 0.0,
        *,
        rods: Selection | None = None,
        over: Literal["time", "arc_length", "position"] = "time",
        shell: int | None = None,
    ) -> None:
        """Prescribe a rest strain of rods, or the rest form of a shell, as a field: muscles, growth, swelling.

        A step uses the values at its end, a step of the midpoint rule the values at its middle, and queries of a state the values
        at its time. In statics the load parameter is the time. Values are written to existing memory of the model: a change costs
        no solver selection and no graph capture.

        Args:
            name: name of the field, as in `Controls(fields={name: values})`, which replaces its values for a step.
            parameter: "term.parameter", such as "rod_bend_twist.rest_1" (curvature 1 [1/m]), "rod_bend_twist.rest_3" (twist
                [1/m]), "planar_bend.rest" (curvature) or "rod_stretch.rest" [1]. Of a shell "metric", "curvature" or "angle", with
                values as of `Model.set_rest`.
            values: one number, an array, or a function that returns a number or an array. Arrays broadcast to (elements,) of one
                rod, or to (rods, elements) of rods with equally many elements. Of other rods they are (all elements,), rod after
                rod. Elements are vertices, or edges of "rod_stretch", clamped ends included (see `Model.set_parameter`).
            rods: one rod or several; by default all rods added so far.
            over: arguments of a function: f(t) for "time", f(s, t) for "arc_length", f(X, t) for "position". s are arc lengths of
                elements from the first node [m]. X are their rest positions (..., 3) [m]. `Samples` is such a function.
            shell: index of a shell instead of rods, with functions of time only, the same in all worlds.

        Raises:
            SceneError: the name is taken, or an argument is invalid. At `build`: rods lack the parameter or have it in two
                fields, or values do not fit.
        """
        argument_checks.text("prescribe: name", name)
        argument_checks.text(f"prescribe '{name}': parameter", parameter)
        argument_checks.choice(f"prescribe '{name}': over", over, OVER)
        if any(prescribed.name == name for prescribed in self.fields):
            raise SceneError(f"prescribe: there is a field '{name}' already; give another name")
        if shell is not None:
            argument_checks.choice(f"prescribe '{name}': parameter of a shell", parameter, FORMS)
            shell = argument_checks.index(f"prescribe '{name}': shell", shell)
            if not 0 <= shell < len(self.shells):
                raise SceneError(
                    f"prescribe '{name}': shell {shell} does not exist; the scene has {len(self.shells)} shells"
                )
            if rods is not None or over != "time":
                raise SceneError(
                    f"prescribe '{name}': a shell has functions of time, and no rods; leave rods and over out"
                )
            rods = np.zeros(0, int)
        else:
            if rods is None and not self.rod_count:
                raise SceneError(f"prescribe '{name}': the scene has no rods so far; add rods before, or name a shell")
            rods = self._rods(range(self.rod_count) if rods is None else rods)
            rods = argument_checks.once(f"prescribe '{name}': rods", rods)
        if not callable(values):
            label = f"prescribe '{name}': values"
            values = argument_checks.array(label, values, "give numbers, or a function").copy()
            argument_checks.sized(label, values, least=0.0)
        self.fields.append(
            PrescribedParameter(name, parameter, rods, Field(f"the field '{name}'", values, None), over, shell)
        )
