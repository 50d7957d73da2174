"""The seven methods, one file for each value of ``method=`` (``moe`` is in ``mcp``), and the code that they share.

A method is two functions. The first makes the *parts*, named networks that transfer keeps, freezes or makes anew. The
second connects the parts to an :class:`~torchrl_mcp.methods.actor.Actor`.
"""
