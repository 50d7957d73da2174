"""Measures of a walk, from its poses alone."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.kinematics import body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.inspection.signals import LegSignals, RootSignals, leg_signals, root_signals
from torchrl_mcp.envs.motions.inspection.strides import Stride, find_strides

LEAST_FPS = 60.0
"""Frame rate below which a clip is resampled, to locate events within a hundredth of a second."""


class GaitStatistics(NamedTuple):
    """Measures of S strides, each of shape ``(S,)``, in metres, seconds and degrees.

    Angles of thigh, arm and foot are in the plane of progression, positive forward and toes up; list and roll are about
    the direction of progression. A range is the greatest value minus the least. Percentages are of the stride. Measures
    of arms are NaN without arms.

    Args:
        stride_time: Time from a heel strike to the next of the same foot.
        speed: Speed along the heading, in m/s.
        turn_rate: Turn rate to the left, in rad/s.
        step_width: Distance between the ankles in their mid-stances, across the heading.
        stance: Fraction of the stride with the foot down.
        double_support: Fraction of the stride with both feet down.
        bob: Range of the root's height.
        sway: Range of the root's distance from its path.
        thigh_forward: Greatest angle of the thigh.
        thigh_back: Least angle of the thigh.
        knee_strike: Flexion of the knee at heel strike.
        knee_loading: Greatest flexion of the knee in the first 30 %.
        knee_stance: Least flexion of the knee between 20 and 50 %.
        knee_swing: Greatest flexion of the knee.
        ankle_dorsiflexion: Greatest dorsiflexion between 30 and 62 %.
        ankle_plantarflexion: Least dorsiflexion between 55 and 85 %.
        pitch_strike: Pitch of the foot at heel strike.
        pitch_toe_off: Least pitch of the foot, shortly after toe-off.
        pelvis_yaw: Range of the pelvis's yaw.
        pelvis_list: Range of the pelvis's list.
        shoulder_yaw: Range of the trunk's yaw.
        yaw_correlation: Correlation of yaw between pelvis and trunk: -1 if they swing against each other.
        trunk_roll: Range of the trunk's roll.
        trunk_lean: Mean roll of the trunk to the left.
        arm_swing: Range of the upper arm's angle.
        elbow_mean: Mean flexion of the elbow.
        elbow_swing: Range of the elbow's flexion.
        toe_clearance: Difference of the 95 % and 5 % quantiles of the height of the sole at the toes.
        slide: Median horizontal speed of the ankle between 15 and 40 %, in m/s.
    """

    stride_time: Tensor
    speed: Tensor
    turn_rate: Tensor
    step_width: Tensor
    stance: Tensor
    double_support: Tensor
    bob: Tensor
    sway: Tensor
    thigh_forward: Tensor
    thigh_back: Tensor
    knee_strike: Tensor
    knee_loading: Tensor
    knee_stance: Tensor
    knee_swing: Tensor
    ankle_dorsiflexion: Tensor
    ankle_plantarflexion: Tensor
    pitch_strike: Tensor
    pitch_toe_off: Tensor
    pelvis_yaw: Tensor
    pelvis_list: Tensor
    shoulder_yaw: Tensor
    yaw_correlation: Tensor
    trunk_roll: Tensor
    trunk_lean: Tensor
    arm_swing: Tensor
    elbow_mean: Tensor
    elbow_swing: Tensor
    toe_clearance: Tensor
    slide: Tensor

    @property
    def stride_length(self) -> Tensor:
        """Distance along the heading in a stride, in metres."""
        return self.speed * self.stride_time

    @property
    def cadence(self) -> Tensor:
        """Steps per minute: two for each stride."""
        return 120 / self.stride_time

    def select(self, strides: Tensor) -> "GaitStatistics":
        """Keep the strides of a mask, shape ``(S,)``."""
        return GaitStatistics(*(field[strides] for field in self))

    def medians(self) -> dict[str, float]:
        """Median of each measure over the strides, by name."""
        return {name: float(field.quantile(0.5)) for name, field in self._asdict().items()}


def gait_statistics(clip: MotionClip) -> GaitStatistics:
    """Measure every complete stride of a humanoid or biped, of either foot, without a stop.

    Args:
        clip: Clip of a character whose legs have thigh, shank and foot; a loop is unrolled.
    """
    clip = _prepared(clip)
    states = body_states(clip.character, clip.qpos, clip.qvel)
    coarse = root_signals(clip, states, window=1.0)
    strides = find_strides({side: leg_signals(clip, states, side, coarse) for side in ("right", "left")}, clip.fps)
    if not strides:
        return GaitStatistics(*torch.empty(len(GaitStatistics._fields), 0, dtype=torch.float64))
    # A Hann window of two strides removes everything that repeats with the stride.
    typical = torch.tensor([stride.end - stride.start for stride in strides]).median()
    root = root_signals(clip, states, window=2 * float(typical) / clip.fps)
    legs = {side: leg_signals(clip, states, side, root) for side in ("right", "left")}
    rows = [_measured(stride, root, legs, clip.fps) for stride in strides]
    return GaitStatistics(*torch.tensor(rows, dtype=torch.float64).unbind(-1))


def _prepared(clip: MotionClip) -> MotionClip:
    """Return the clip with at least ten seconds of a loop, and a sufficient frame rate."""
    if clip.loop:
        times = torch.arange(0, max(10.0, clip.duration), 1 / clip.fps, dtype=torch.float64)
        clip = MotionClip(clip.character, clip.at(times), clip.fps)
    return clip if clip.fps >= LEAST_FPS else clip.resampled(2 * LEAST_FPS)


def _measured(stride: Stride, root: RootSignals, legs: dict[str, LegSignals], fps: float) -> list[float]:
    """All of :class:`GaitStatistics` for one stride, in order."""
    leg = legs[stride.side]
    other = legs[stride.other]
    frames = stride.end - stride.start
    both = (stride.other_toe_off - stride.start) + (stride.toe_off - stride.other_start)
    turned = root.heading[stride.end] - root.heading[stride.start]
    width = leg.across[stride.part(0.15, 0.4)].mean() - other.across[stride.part(0.65, 0.9)].mean()
    whole = stride.part(0, 1)
    yaws = torch.stack([root.pelvis_yaw[whole], root.trunk_yaw[whole]])
    toes = leg.toe_height[whole].quantile(torch.tensor([0.05, 0.95], dtype=torch.float64))
    values: dict[str, float | Tensor] = {
        "stride_time": frames / fps,
        "speed": root.speed[whole].mean(),
        "turn_rate": turned * fps / frames,
        "step_width": width.abs(),
        "stance": (stride.toe_off - stride.start) / frames,
        "double_support": both / frames,
        "bob": _range(root.height[whole]),
        "sway": _range(root.sway[whole]),
        "thigh_forward": leg.thigh[whole].max(),
        "thigh_back": leg.thigh[whole].min(),
        "knee_strike": leg.knee[stride.start],
        "knee_loading": leg.knee[stride.part(0, 0.3)].max(),
        "knee_stance": leg.knee[stride.part(0.2, 0.5)].min(),
        "knee_swing": leg.knee[whole].max(),
        "ankle_dorsiflexion": leg.ankle[stride.part(0.3, 0.62)].max(),
        "ankle_plantarflexion": leg.ankle[stride.part(0.55, 0.85)].min(),
        "pitch_strike": leg.pitch[stride.start],
        "pitch_toe_off": leg.pitch[whole].min(),
        "pelvis_yaw": _range(root.pelvis_yaw[whole]),
        "pelvis_list": _range(root.pelvis_list[whole]),
        "shoulder_yaw": _range(root.trunk_yaw[whole]),
        "yaw_correlation": torch.corrcoef(yaws)[0, 1],
        "trunk_roll": _range(root.trunk_roll[whole]),
        "trunk_lean": root.trunk_roll[whole].mean(),
        "arm_swing": _range(leg.arm[whole]),
        "elbow_mean": leg.elbow[whole].mean(),
        "elbow_swing": _range(leg.elbow[whole]),
        "toe_clearance": toes[1] - toes[0],
        "slide": leg.ankle_speed[stride.part(0.15, 0.4)].median(),
    }
    return [float(values[name]) for name in GaitStatistics._fields]


def _range(values: Tensor) -> Tensor:
    return values.max() - values.min()
