"""Bodies: what MuJoCo needs to simulate them, and nothing of any task."""

from torchrl_mcp.envs.characters.ant import ant

__all__ = ["ant"]
