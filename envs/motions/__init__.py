"""Reference motions: clips, libraries of clips, and a generator of walking."""

from torchrl_mcp.envs.motions.clip import MotionClip, concatenated

__all__ = ["MotionClip", "concatenated"]
