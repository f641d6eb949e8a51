"""How the kernels of the light transport are compiled."""

from typing import Any

COMPILE: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
"""Options of `numba.njit`: machine code is kept between runs, threads run side by side, division needs no check.

Not `fastmath`: sums keep their order, so that the same seed gives the same bytes.
"""

INLINE: dict[str, Any] = COMPILE | {"forceinline": True}
"""The same for small functions, which would spend their time on being called: a scene is many arrays."""
