"""Output of ``acquire reconstruct``: the plan before the solver runs, and the videos it has made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.cli.output import note, print_facts, print_json, print_table, print_warning, say

if TYPE_CHECKING:
    from acquire.cli.reconstruct_request import Prepared
    from acquire.reconstruct import Outcome

COMPILED_S = 0.05
"""A shorter compilation is not mentioned."""


def print_prepared(prepared: Prepared) -> None:
    """Print the plan, if there is one, and the preset chosen by past experience."""
    if prepared.learned:
        note(f"preset {prepared.options.preset}: {prepared.learned}")
    if prepared.plan is not None:
        rows = [
            (part.name or number, part.length, f"{part.spatial_merge}x{part.temporal_merge}", part.why)
            for number, part in enumerate(prepared.plan.segments, 1)
        ]
        print_table(("segment", "length", "voxels", "reason"), rows)
        say()


def print_outcomes(outcomes: list[Outcome], *, json: bool, preview: bool, more: dict[str, Any]) -> None:
    """Print the facts, the sub-segments and the warnings of each video.

    A preview gets no warnings: that its large voxels do not explain the lines is expected. ``more`` is added
    to the JSON of each.
    """
    if json:
        facts = [
            {"path": str(each.path), "shape": each.shape, **each.provenance, **more} for each in outcomes
        ]
        print_json(facts[0] if len(facts) == 1 else facts)
        return
    for outcome in outcomes:
        print_facts(_outcome_facts(outcome))
        if preview:
            continue
        segments = outcome.provenance["segments"]
        # Of a single one the facts above have said everything.
        if len(segments) > 1:
            say()
            rows = [
                (
                    part["name"] or (f"tile {part['tile']}" if part["tile"] else number),
                    f"{part['spatial_merge']}x{part['temporal_merge']}",
                    part["end_substep"] - part["begin_substep"],
                    f"{part['first_line']} to {part['first_line'] + part['lines'] - 1}",
                    part["iterations"],
                    f"{part['seconds']:.1f}",
                    f"{part['quality']['misfit']:.2%}",
                    "no" if not part["trusted"] else "in part" if part["unseen"] else "yes",
                )
                for number, part in enumerate(segments, 1)
            ]
            columns = (
                "segment",
                "voxels",
                "sub-steps",
                "lines",
                "iterations",
                "seconds",
                "misfit",
                "trusted",
            )
            print_table(columns, rows)
        for text in outcome.provenance["warnings"]:
            print_warning(text)


def _outcome_facts(outcome: Outcome) -> dict[str, Any]:
    from acquire.loops import how_often
    from acquire.recon import Quality
    from acquire.showing import error_in_words

    facts, quality = outcome.provenance, outcome.provenance["quality"]
    done, total = len(facts["segments"]), facts["segments_asked"]
    solved = sum(part["trusted"] for part in facts["segments"])
    ended = None
    if outcome.interrupted:
        ended = f"the video has {done} of {total} sub-segments, {done - solved} of them unfinished"
    elif outcome.cut:
        ended = f"the time limit was reached after {done} of {total} sub-segments"

    first, end = facts["trusted"]
    reason = "all frames are sampled only in part" if solved else "no sub-segment was finished"
    if solved and any(part["unseen"] for part in facts["segments"]):
        reason = "an arm has no usable sample of the others"
    iterations, of_iterations = facts["iterations"], facts["iterations_asked"]
    iterated = f"{iterations} of {of_iterations}" if iterations < of_iterations else str(iterations)
    noise = None
    if quality.get("noise") is not None:
        # What is not known is None in the provenance, which is JSON, and NaN in `Quality`.
        known = {key: float("nan") if value is None else value for key, value in quality.items()}
        noise = f"{quality['noise']:.2%} from the cameras: the lines are {Quality(**known).standing}"
    prediction = quality["prediction"]
    return {
        "video": f"{outcome.path}, {' × '.join(map(str, outcome.shape))} (time, row, column)",
        "interrupted": ended,
        "tiles": _tile_range(facts),
        "search": _search_summary(facts["choice"]),
        "trusted": f"frames {first} to {end - 1}" if end > first else f"none: {reason}",
        "solver": f"{facts['solver']}, {iterated} iterations, {facts['seconds']:.1f} s",
        "corrected": ", ".join(facts["calibration"]["corrected"]) if facts["calibration"] else None,
        "compiled": f"{facts['compiled_s']:.1f} s of this time, needed {how_often()}"
        if facts["compiled_s"] >= COMPILED_S
        else None,
        "misfit": f"{quality['misfit']:.2%} of the samples' RMS",
        "prediction": None if prediction is None else f"{prediction:.2%} error at held-out samples",
        "error": error_in_words(facts["error"]),
        "noise": noise,
        "coverage": f"{quality['coverage']:.2%} of the samples usable",
    }


def _tile_range(facts: dict[str, Any]) -> str | None:
    """Tiles of a scene behind a fibre, and how many of them are finished."""
    if not (tiles := facts["tiles"]):
        return None
    # Every tile has all sub-segments that were asked for.
    finished = len(facts["segments"]) * len(tiles) // facts["segments_asked"]
    which = tiles[0] if len(tiles) == 1 else f"{tiles[0]} to {tiles[-1]}"
    return f"{which}, {finished} of {len(tiles)}"


def _search_summary(choice: dict[str, list[str]] | None) -> str | None:
    """State which tile or sub-segment searched for prior and weight, and how many of the others kept them."""
    if choice is None or not choice["kept"] + choice["changed"]:
        return None
    others = f"kept by {len(choice['kept'])}"
    if choice["changed"]:
        others += f", changed by {len(choice['changed'])} ({', '.join(choice['changed'])})"
    return f"by {', '.join(choice['searched'])} for all; {others}"
