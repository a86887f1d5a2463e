"""Reuse of a choice of prior, weight and band that was made on another part of the scene.

Most of the time of a reconstruction is its search (`acquire.recon.choose`). What was chosen for one tile, or
one range of time, is tried first on the next, and kept if it predicts the held-out blocks as closely as where
it was chosen, in units of the noise. Larger weights are tried next to it, because noise that a small weight
admits hardly shows in the lines. If it does not fit, a still is searched for from there, and a video as if
nothing had been handed over. If the choice is a moving prior, a still is tried as well, which costs little,
so that a part at rest next to a moving part is not made to move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from acquire.recon.blinking import AT_REST, first_look, refine
from acquire.recon.candidates import LARGEST_WEIGHT, STILL, WEIGHT_STEP, Candidate, rounded
from acquire.recon.cycle import FEWEST_CYCLES
from acquire.recon.estimates import Preferred
from acquire.recon.result import EXPLAINED
from acquire.recon.spectrum import learn_spectrum
from acquire.recon.workbench import FIRST_ITERATIONS, NEXT_ITERATIONS, SEARCH_SHARE

if TYPE_CHECKING:
    from acquire.recon.estimates import Estimate
    from acquire.recon.result import Reconstruction
    from acquire.recon.workbench import Trial, Workbench

AS_CLOSELY = 1.05
"""Largest held-out error in units of the noise, relative to that where the choice was made, for which it
fits: a search takes 2 % for a gain, and errors of a few hundred blocks differ by as much as this by
chance."""
COSINES_PRIOR = "cosines"


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen, and how well it predicted: ``error`` and ``noise`` are relative to the samples.

    ``prior`` is that of a candidate, or `COSINES_PRIOR`, of which only the number is handed over.
    ``brightness`` is the number of cosines of the whole scene's brightness, 0 if that is constant,
    ``period_frames`` that of a cycle, ``drift`` a volume's velocity in sides of the picture per frame
    (without the bends of its path, which are of that part only), and ``rotation`` a cycle's turn, or a
    volume's with its turns per frame; the next part fits them to its lines, and it learns a spectrum of its
    own if that of a smooth volume was ``learned``.
    """

    prior: str
    coefficients: int
    weight: float
    pace: float
    error: float
    noise: float
    brightness: int = 0
    fine: bool = False
    period_frames: float = 0.0
    ground: float = 0.0
    drift: tuple[float, ...] = ()
    rotation: tuple[float, ...] = ()
    learned: bool = False

    @classmethod
    def of(cls, result: Reconstruction) -> Self | None:
        """The choice of a reconstruction; None if nothing was chosen, or if it depends on an object there."""
        found, quality = result.parameters, result.quality
        # Robust weights and a change's still are of this segment's lines.
        if "candidates" not in found or found.get("robust") or found.get("change"):
            return None
        counts = [
            each["temporal_coefficients"] for each in found["candidates"] if each["prior"] == COSINES_PRIOR
        ]
        in_cosines, cyclic = found["prior"] == COSINES_PRIOR, "harmonics" in found
        per_frame = 1.0 if cyclic else 1 / len(result.video)
        return cls(
            prior=found["prior"],
            # In a cycle, the cosines up to its fastest harmonic are not what is solved for.
            coefficients=2 * found["harmonics"] + 1 if cyclic else found["temporal_coefficients"],
            weight=0.0 if in_cosines else found["weight"],
            pace=0.0 if in_cosines else found["pace"],
            error=quality.prediction,
            noise=quality.noise,
            brightness=counts[0] if found.get("brightness") and counts else 0,
            fine=bool(found.get("fine")),
            period_frames=found.get("period_frames", 0.0),
            ground=found.get("ground", 0.0),
            drift=tuple(each / len(result.video) for each in found.get("drift", ())[:2]),
            rotation=_times_turns(per_frame, found.get("rotation", ())),
            learned=bool(found.get("learned")),
        )

    def fits(self, error: float, noise: float) -> bool:
        """Whether samples are predicted as closely as where it was chosen, in units of the noise if known.

        A choice that did not explain its own samples sets no looser standard than one that did.
        """
        if self.noise > 0 and noise > 0:
            return error / noise <= AS_CLOSELY * min(self.error / self.noise, EXPLAINED)
        return error <= AS_CLOSELY * self.error

    def kept(self, parameters: dict[str, Any]) -> bool:
        """Whether a reconstruction with these parameters has kept this choice."""
        same = parameters.get("prior") == self.prior
        if not same or bool(parameters.get("brightness")) != bool(self.brightness):
            return False
        return self.prior == COSINES_PRIOR or (parameters["weight"], parameters["pace"]) == (
            self.weight,
            self.pace,
        )

    def candidate(self, frames: int) -> Candidate:
        """The candidate to try on this many frames."""
        cosines = min(self.coefficients, frames)
        bright, fine = bool(self.brightness), self.fine
        drift = tuple(each * frames for each in self.drift)
        known = {
            "brightness": bright,
            "fine": fine,
            "period_frames": self.period_frames,
            "drift": drift,
            "rotation": _times_turns(1.0 if self.period_frames else frames, self.rotation),
        }
        return Candidate(self.prior, cosines, self.weight, self.pace, self.ground, **known)  # type: ignore[arg-type]  # not cosines


def _times_turns(factor: float, rotation: tuple[float, ...]) -> tuple[float, ...]:
    return (factor * rotation[0], *rotation[1:]) if rotation else ()


def reuse_choice(bench: Workbench, trials: int) -> Estimate | None:
    """Solve with the choice handed over; None if it does not fit, so that everything has to be searched."""
    choice, frames, clock = bench.given.options.choice, bench.frames, bench.clock
    assert choice is not None
    noise, at_rest = bench.given.noise, choice.prior == STILL.prior
    if at_rest:
        own = bench.with_problem(bench.problem, fine=choice.fine)
        still = own.attempt(choice.candidate(frames), FIRST_ITERATIONS)
    else:
        still = bench.attempt(bench.fitting(STILL), FIRST_ITERATIONS)
    fits = at_rest and choice.fits(still.error, noise)
    # If noise is all that a still leaves, nothing has to move.
    if fits or still.error <= AS_CLOSELY * noise or clock.spent(SEARCH_SHARE):
        return bench.finish(_strengthened(still))
    if at_rest:
        return bench.finish(still.bench.climb(still, trials)) if frames == 1 else None
    if choice.prior == COSINES_PRIOR:
        return _in_cosines(bench, still)
    if choice.period_frames * FEWEST_CYCLES > frames:
        return None
    bright = None
    if choice.brightness:
        bright = bench.brighten(bench.video(still).clip(0), choice.brightness, still.error)
        if bright is None or not bright.error < still.error:
            return None
    moving = _moving(bench, choice, bright)
    best = moving if bench.held_out.clearly_less(moving.errors, still.errors) else still
    return bench.finish(_strengthened(best)) if choice.fits(best.error, noise) else None


def _moving(bench: Workbench, choice: Choice, start: Trial | None) -> Trial:
    """A video with the choice handed over, whose path, speed or spectrum is fitted to the lines."""
    on_path = choice.drift or choice.rotation
    # A step from a video at rest to one on a path hardly arrives there.
    moving = bench.attempt(choice.candidate(bench.frames), FIRST_ITERATIONS, None if on_path else start)
    if choice.brightness:
        moving = bench.alternate(moving)
    elif on_path:
        moving = bench.follow_path(moving)
    if choice.period_frames:
        # What was handed over had more iterations.
        moving = bench.follow_speed(moving)
        moving = bench.attempt(moving.candidate, NEXT_ITERATIONS, moving)
    return learn_spectrum(moving) if choice.learned else moving


def _strengthened(best: Trial) -> Trial:
    """The trial with the largest weight that does not worsen its prediction."""
    clock = best.bench.clock
    if best.candidate.learned:  # and so is what takes the place of a weight
        return best
    while not clock.spent(SEARCH_SHARE) and best.candidate.weight * WEIGHT_STEP <= LARGEST_WEIGHT:
        stronger = replace(best.candidate, weight=rounded(best.candidate.weight * WEIGHT_STEP))
        found = best.bench.attempt(stronger, NEXT_ITERATIONS, best)
        if not found.error < best.error:
            break
        best = found
    return best


def _in_cosines(bench: Workbench, still: Trial) -> Estimate | None:
    """Solve in the band handed over, as `choose` does where cosines are ahead of a still."""
    choice = bench.given.options.choice
    assert choice is not None
    band = replace(bench.given.options, bandwidth=min(1.0, choice.coefficients / bench.frames))
    given = replace(bench.given, options=band)
    # As in `choose`, the code would stay in the brightness from a start at zero.
    start = still.admm.theta if still.error < AT_REST else None
    cosines = first_look(given, start)
    bench.record_errors({"prior": COSINES_PRIOR} | cosines.facts(), cosines.predict())
    found = refine(given, cosines)
    errors = bench.record_errors({"prior": "patterns"} | found.facts(), found.predict())
    ahead = bench.held_out.clearly_less(errors, still.errors)
    if ahead and choice.fits(bench.held_out.relative(errors), given.noise):
        return Preferred(found, bench.record)
    given.clock.reset()  # the search that follows may use all of its iterations
    return None
