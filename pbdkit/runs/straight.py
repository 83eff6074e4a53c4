"""Straight to where the steps lead."""

from __future__ import annotations

from pbdkit.equilibrium.finding import UnconvergedError
from pbdkit.equilibrium.increments import settle
from pbdkit.equilibrium.watch import StoppedError
from pbdkit.results.recorder import Outcome
from pbdkit.runs.driver import Driver, States
from pbdkit.stepping.choice import Choice


class Straight(Driver):
    """The driver of the solver `equilibrium`: gives out the start and the equilibrium."""

    choice = Choice("equilibrium", 1, "asked for")

    def states(self) -> States:
        """Interrupted, it gives out how far it had come."""
        state, steps = self.state, self.scene.experiment.steps
        yield state
        try:
            certificate = settle(self.scene, state, self.watch)
            outcome = Outcome("complete", str(certificate), steps, certificate.as_dict())
        except UnconvergedError as error:
            found = error.certificate
            outcome = Outcome("unconverged", f"{error}: {found}", steps, found.as_dict())
        except StoppedError:
            self.ending = True
            yield state
            reason = f"stopped on the way to equilibrium, after step {state.step}"
            return Outcome("interrupted", reason, state.step)
        state.step = steps
        yield state
        if self.rejection:
            return Outcome("unconverged", f"{self.rejection} left all bounds", steps)
        return outcome
