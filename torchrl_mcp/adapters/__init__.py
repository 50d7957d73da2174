"""Environments of other libraries, and the contract that they satisfy together with the library's own."""
