"""Tables about imported motions, and remarks on what may have been read incorrectly."""

import math
from collections.abc import Callable, Mapping

from torch import Tensor

from torchrl_mcp.envs.motions.capture.fit import Import
from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
from torchrl_mcp.envs.motions.inspection.feasibility import feasibility
from torchrl_mcp.envs.motions.inspection.statistics import GaitStatistics, gait_statistics
from torchrl_mcp.envs.motions.inspection.summary import GLIDING, SLIDING, Summary, summarised

CAUSES = "unit, frame rate, map or order of rotations"
"""Settings that make feet slide if they are wrong."""

STRIDES: dict[str, Callable[[GaitStatistics], Tensor]] = {
    "length m": lambda strides: strides.stride_length,
    "steps/min": lambda strides: strides.cadence,
    "width m": lambda strides: strides.step_width,
    "stance": lambda strides: strides.stance,
    "double support": lambda strides: strides.double_support,
    "bob m": lambda strides: strides.bob,
    "sway m": lambda strides: strides.sway,
    "knee swing deg": lambda strides: strides.knee_swing,
    "foot strikes deg": lambda strides: strides.pitch_strike,
    "arm swing deg": lambda strides: strides.arm_swing,
}
"""Columns of the table of strides, which shows medians."""


def clip_table(motions: Mapping[str, Import]) -> tuple[list[dict[str, str]], list[str]]:
    """Return a row of measures for each clip and one for all, and remarks on clips that may have been read incorrectly.

    Args:
        motions: The motions by name, at least one.
    """
    summaries = {name: summarised(motion.clip) for name, motion in motions.items()}
    rows = [_row(name, motion, summaries[name]) for name, motion in motions.items()]
    total = f"{sum(summary.duration for summary in summaries.values()):.1f}"
    rows.append({**dict.fromkeys(rows[0], ""), "clip": "total", "seconds": total})
    return rows, [*_on_import(motions), *_on_ground(summaries)]


def stride_table(motions: Mapping[str, Import]) -> list[dict[str, str]]:
    """Return a row of medians over the complete strides of each clip of a human body."""
    rows = []
    for name, motion in motions.items():
        if motion.clip.character not in HUMANS:
            continue
        strides = gait_statistics(motion.clip)
        number = len(strides.speed)
        cells = {column: _median(measure(strides)) if number else "-" for column, measure in STRIDES.items()}
        rows.append({"clip": name, "strides": str(number), **cells})
    return rows


def _median(values: Tensor) -> str:
    median = float(values.quantile(0.5))
    return "-" if math.isnan(median) else f"{median:.3g}"


def _row(name: str, motion: Import, summary: Summary) -> dict[str, str]:
    clip = motion.clip
    cut = motion.cut
    demand = feasibility(clip)
    return {
        "clip": name,
        "character": clip.character,
        "seconds": f"{summary.duration:.2f}",
        "frames/s": f"{clip.fps:.4g}{' loop' if clip.loop else ''}",
        "m/s": f"{summary.speed:.2f}",
        "|rad/s|": f"{summary.turn_rate:.2f}",
        "slide m/s": "-" if math.isnan(summary.slide) else f"{summary.slide:.3f}",
        "standing soles": "-" if math.isnan(summary.sole) else f"{round(100 * summary.sole, 1) + 0.0:.1f} cm",
        "cut to limits": f"{cut.max():.1f} deg, {100 * (cut > 1).double().mean():.0f} %" if len(cut) else "-",
        "beyond limits": f"{math.degrees(demand.limit):.1f} deg",
        "below ground": f"{100 * demand.penetration:.1f} cm",
        "legs in legs": f"{100 * demand.crossing:.1f} cm",
        "torque/limit": f"{demand.torque:.2f}",
        "rest pose leans": "-" if math.isnan(motion.rest_lean) else f"{motion.rest_lean:.1f} deg",
    }


def _on_import(motions: Mapping[str, Import]) -> list[str]:
    """Return remarks on what the import missed or assumed."""
    lines = []
    for name, motion in motions.items():
        if motion.bodies:
            median = float(motion.missed.quantile(0.5))
            most = float(motion.missed.max())
            lines.append(
                f"Bones miss their directions in {name} by {median:.1f} deg in the median, {most:.1f} deg at most."
            )
    for character, bodies in {motion.clip.character: motion.bodies for motion in motions.values()}.items():
        if bodies:
            pairs = ", ".join(f"{part}: {body}" for part, body in bodies.items())
            lines.append(f"{character} follows with {pairs}. If this is wrong, give a file of such lines (--bodies).")
    for name, motion in motions.items():
        if motion.assumed:
            lines.append(
                f"Assumed for {name}: {motion.assumed}. If this is wrong, say which axis points up (--up) or which "
                "frame stands (--rest-frame)."
            )
    for note in dict.fromkeys(motion.ground for motion in motions.values() if motion.ground):
        names = ", ".join(name for name, motion in motions.items() if motion.ground == note)
        lines.append(f"In {names}, {note}.")
    return lines


def _on_ground(summaries: Mapping[str, Summary]) -> list[str]:
    """Return remarks on feet that slide and bodies that glide."""
    sliding = [name for name, summary in summaries.items() if summary.slide > SLIDING]
    gliding = [name for name, summary in summaries.items() if summary.gliding > GLIDING and name not in sliding]
    lines = []
    if sliding:
        lines.append(f"The feet slide in {', '.join(sliding)}: {CAUSES} may be wrong.")
    if gliding:
        lines.append(f"No part of the body rests on the ground in {', '.join(gliding)}: {CAUSES} may be wrong.")
    return lines
