"""Steps of second order of the variables of a lens, for any loss of a camera.

The loss is lifted into the rays of the lens (`optimization.lifted`): a step is one of damped least squares in the
metric of the RMS blur, within the bounds and under the conditions of the variables, which it meets exactly.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from raytrace.imaging.constraints import with_limits
from raytrace.imaging.variables import Variables
from raytrace.optimization.least_squares import Descent, Slope, SumOfSquares, TensorDescent
from raytrace.optimization.lifted import OPTIONS, Lifted
from raytrace.optimization.merit import DefaultMerit
from raytrace.optimization.problem import NoProblem, Problem, refuse_detached, scalar_loss, typical_of
from raytrace.tracing.compiled import prepare
from raytrace.words import named_value


class LensSteps:
    """Steps of the parameters of `Variables`; those that need no gradient do not move.

    A KeyboardInterrupt leaves the parameters at the best lens so far. memory: of earlier steps, which are resumed.
    """

    def __init__(self, variables: Variables, memory: dict | None = None):
        prepare()
        self.variables, self.damping = variables, OPTIONS.damping
        rows = DefaultMerit("spot").rows(variables.free.lens)
        self.problem = Problem(variables.free, rows, variables.held_to)
        self._values: list[float] = []
        self._loss: Callable[[], Tensor] = lambda: torch.zeros(())
        self._last: tuple[bytes, Slope] | None = None
        lower, upper = self._ends()
        self.lifted = Lifted(self._function, self._rows, lower=lower, upper=upper, typical=typical_of(variables.free))
        if memory is not None:
            self.damping = memory["damping"]
            self.lifted.resume(memory)

    def memory(self) -> dict:
        """Damping, curvature and places of the last steps, as plain values for JSON, with which steps resume."""
        return {"damping": self.damping, **self.lifted.memory()}

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        return [self.variables.get_parameter(variable.name) for variable in self.variables.variables]

    def step(self, loss: Callable[[], Tensor]) -> float:
        """Take a step that lowers a loss, a function without arguments of the current lens; its value before the step.

        The loss of every call may be another one, as of another batch of pictures: its curvature follows from changes
        of the gradient within a call.
        """
        self._begin(loss)
        self._refuse_infinite()
        descent = self.lifted.step(self._numbers(), self.damping)
        self.damping = descent.cycles[-1].damping if descent.cycles else OPTIONS.damping
        self._end(descent)
        return self._values[0]

    def minimise_spots(self, *, cycles: int = 100) -> None:
        """Move to the smallest spots of the lens's own fields, wavelengths and object distance."""
        self.lifted.lower, self.lifted.upper = self._ends()
        self._end(self.lifted.minimise_rows(self._numbers(), cycles=cycles))

    def minimise(self, loss: Callable[[], Tensor], *, cycles: int = 300) -> TensorDescent:
        """Descend to the minimum of a loss, a function without arguments of the current lens."""
        self._begin(loss)
        self._refuse_infinite()
        start = self._numbers()
        is_flat = not self._function(start)[1].any()
        descent = self.lifted.descend(start, cycles=0 if is_flat else cycles)
        self._end(descent)
        x, gradient = descent.state.x, self._function(descent.state.x)[1]
        reached = np.where(gradient > 0, self.lifted.lower, self.lifted.upper)
        at_end = (gradient != 0) & np.isclose(x, reached, rtol=1e-9, atol=1e-9)
        return TensorDescent((*self._values, descent.state.cost), tuple(at_end.tolist()), is_flat)

    def _refuse_infinite(self) -> None:
        """Raise NoProblem, before anything moves, for a loss without a finite number and gradient."""
        value, gradient = self._function(self._numbers())
        if not (math.isfinite(value) and np.isfinite(gradient).all()):
            what = f"loss is {value:g}" if not math.isfinite(value) else "gradient of the loss is not finite"
            raise NoProblem(
                f"the {what} at the current lens, which was left as it is: check the pictures of this step, and that "
                "all fields and distances have light"
            )

    def _begin(self, loss: Callable[[], Tensor]) -> None:
        if not callable(loss):
            raise TypeError(f"the loss is {named_value(loss)}; expected a function, as lambda: … .mean()")
        self._loss, self._last = loss, None
        self.lifted.lower, self.lifted.upper = self._ends()
        self._values.clear()

    def _end(self, descent: Descent) -> None:
        """Move to the end of a descent; a KeyboardInterrupt that ended it is raised again."""
        self._put(descent.state.x)
        if descent.stopped == "interrupted":
            raise KeyboardInterrupt

    @torch.no_grad()
    def _numbers(self) -> np.ndarray:
        pairs = zip(self.variables.variables, self.parameters, strict=True)
        return np.array([variable.start + variable.unit * float(parameter) for variable, parameter in pairs])

    @torch.no_grad()
    def _put(self, x: np.ndarray) -> None:
        for variable, parameter, number in zip(self.variables.variables, self.parameters, x, strict=True):
            parameter.fill_((number - variable.start) / variable.unit)

    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the numbers."""
        x, free = self._numbers(), np.array([parameter.requires_grad for parameter in self.parameters])
        names = [variable.name for variable in self.variables.variables]
        lower, upper = np.array([self.variables.bounds.get(name, (-math.inf, math.inf)) for name in names]).T
        return np.where(free, lower, x), np.where(free, upper, x)

    def _function(self, x: np.ndarray) -> Slope:
        """The loss and its gradient by the numbers."""
        if self._last is not None and self._last[0] == x.tobytes():
            return self._last[1]
        self._put(x)
        moved = [parameter for parameter in self.parameters if parameter.requires_grad]
        with torch.enable_grad():
            loss = scalar_loss(self._loss())
        if moved:
            refuse_detached(loss)
        by = torch.autograd.grad(loss, moved, materialize_grads=True) if moved else None
        gradient, each = np.zeros(len(x)), iter(by or [])
        for k, (variable, parameter) in enumerate(zip(self.variables.variables, self.parameters, strict=True)):
            if by is not None and parameter.requires_grad:
                gradient[k] = float(next(each)) / variable.unit
        self._values.append(float(loss.detach()))
        self._last = x.tobytes(), (self._values[-1], gradient)
        return self._last[1]

    def _rows(self, x: np.ndarray, derivatives: bool) -> SumOfSquares:
        state = self.problem.state(x, derivatives)
        return with_limits(state, self.variables.further_limits, x, derivatives=derivatives)
