"""Typed decorators for compiled functions. fastmath is off, so that results do not depend on the machine."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function with numba and keep the result on disk."""
    return cast(Function, numba.njit(cache=True)(function))


def parallel_kernel(function: Function) -> Function:
    """Compile a function whose `numba.prange` loops run on all threads of numba."""
    return cast(Function, numba.njit(cache=True, parallel=True)(function))


def inner(function: Function) -> Function:
    """Compile a function that kernels call often: it may not make arrays, and counts no references to those it gets.

    Counting is atomic, once per array and call: for a pixel or a triangle it costs more than the work.
    """
    return cast(Function, numba.njit(cache=True, _nrt=False)(function))


def inlined(function: Function) -> Function:
    """Compile a small `inner` function of which every call is replaced by its body."""
    return cast(Function, numba.njit(cache=True, _nrt=False, forceinline=True)(function))
