"""What the exercises check answers with: a wrong answer gets a hint that names the mistake.

In a notebook, importing this also changes how errors are shown: see ``_show``.
"""

import linecache
import sys
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np


class Wrong(AssertionError):
    """A wrong answer."""


def check(found: Any, right: Any, hints: Mapping[str, Any] | None = None, tolerance: float = 1e-6) -> None:
    """Nothing where ``found`` is right; else ``AssertionError``, with the hint whose wrong answer it is.

    ``hints``: {hint: the answer that deserves it}. Numbers may differ by ``tolerance``, absolutely and
    relatively; shapes may not differ. A tuple is compared part by part, and a list does in its place.
    """
    if isinstance(right, tuple) and isinstance(found, list):
        found = tuple(found)
    if same(found, right, tolerance):
        return
    for hint, wrong in (hints or {}).items():
        if same(found, wrong, tolerance):
            raise Wrong(hint)
    shapes = _shape(found), _shape(right)
    if shapes[0] != shapes[1]:
        raise Wrong(f"The answer is {shapes[0]}; expected {shapes[1]}.")
    for digits in (4, 16):  # numbers that differ must look different
        texts = _shown(found, digits), _shown(right, digits)
        if texts[0] != texts[1]:
            break
    raise Wrong("The answer is\n{}\nexpected\n{}".format(*texts))


def same(one: Any, other: Any, tolerance: float = 1e-6) -> bool:
    """Are the two equal, numbers to within ``tolerance``?"""
    if isinstance(other, tuple):
        return (
            isinstance(one, (tuple, list))
            and len(one) == len(other)
            and all(same(a, b, tolerance) for a, b in zip(one, other, strict=True))
        )
    if one is None or other is None or isinstance(one, str) or isinstance(other, (str, bool)):
        return type(one) is type(other) and one == other
    a, b = _numbers(one), _numbers(other)
    if a is None or b is None or a.shape != b.shape:
        return False
    return np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)


def _plain(x: Any) -> Any:
    if isinstance(x, (list, tuple)):  # of tensors, maybe
        return [_plain(part) for part in x]
    return x.detach().numpy() if hasattr(x, "detach") else x  # PyTorch is slow to import, and not needed here


def _numbers(x: Any) -> np.ndarray | None:
    """As an array; None if that is no array of numbers."""
    try:
        return np.asarray(_plain(x), dtype=float)
    except (TypeError, ValueError):
        return None


def _shape(x: Any) -> str:
    if isinstance(x, tuple):
        return f"a tuple of {len(x)}"
    if x is None or isinstance(x, (str, bool)):
        return "nothing (is a return missing?)" if x is None else f"a {type(x).__name__}"
    if isinstance(x, list) and any(part is None for part in x):
        return "a list with None in it (is a return missing?)"
    if (array := _numbers(x)) is None:
        return f"a {type(x).__name__} that is no array of numbers"
    return f"an array of shape {array.shape}" if array.shape else "a number"


def _shown(x: Any, digits: int) -> str:
    if isinstance(x, (str, tuple)) or x is None:
        return str(x)
    try:
        return np.array2string(np.round(np.asarray(_plain(x)), digits), precision=digits)
    except TypeError:  # nothing where a number belongs
        return str(x)


def _show(shell: Any, kind: type, error: Exception, trace: Any, tb_offset: int | None = None) -> None:
    """Show an error in a notebook, without the lines of checks: they hold hints and right answers.

    What a check says, and *not yet*, is one line. Any other error is shown from the first line on that is an
    answer's.
    """

    def of_check(step: TracebackType) -> bool:
        lines = linecache.getlines(step.tb_frame.f_code.co_filename)
        return of_cell(step) and any(__name__ in line for line in lines)

    def of_cell(step: TracebackType) -> bool:
        return step.tb_frame.f_globals is shell.user_ns

    while trace and (not of_cell(trace) or of_check(trace)):
        trace = trace.tb_next
    step = trace
    while step:
        while step.tb_next and of_check(step.tb_next):
            step.tb_next = step.tb_next.tb_next
        step = step.tb_next
    if trace is None or isinstance(error, AssertionError) or str(error) == "not yet":
        name = "AssertionError" if isinstance(error, AssertionError) else kind.__name__
        shell._showtraceback(kind, error, [f"{name}: {error}"])
    else:
        shell.showtraceback((kind, error, trace), tb_offset=0)


if "IPython" in sys.modules and (_shell := sys.modules["IPython"].get_ipython()):
    _shell.set_custom_exc((Exception,), _show)
