"""Kernels for the rows of a chunk, compiled by Numba (extra `[fast]`): what they work on stays in a processor's caches.

Importing a module of this package compiles its kernels, or loads what Numba has kept of them on disk. It compiles anew
when the kernel's own module has changed, but not for a change of others: whoever edits one of them deletes the
`*.nbi` and `*.nbc` in `__pycache__`.
"""
