"""The commands ``torchrl-mcp-*``."""
