"""Sparse factors that solve on one core: SuperLU's own solver calls BLAS for every few columns, and BLAS's threads then
wait for work at full load for a while, which makes all other threads slow."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Factors:
    """Pr A Pc = L U: columns of L (diagonal of ones) and U, permutations as SciPy's SuperLU has them."""

    lower: scipy.sparse.csc_array
    upper: scipy.sparse.csc_array
    perm_r: NDArray[np.int32]
    perm_c: NDArray[np.int32]

    def solve(self, right: Array) -> Array:
        """Return x f64[n, m] of A x = right f64[n, m]."""
        x = np.empty(right.shape)
        x[self.perm_r] = right
        _solve_lower(self.lower.indptr, self.lower.indices, self.lower.data, x)
        _solve_upper(self.upper.indptr, self.upper.indices, self.upper.data, x)
        return np.asarray(x[self.perm_c])


def factorize(symmetric: scipy.sparse.csr_array) -> Factors:
    """Factorize a symmetric positive definite matrix."""
    found = scipy.sparse.linalg.splu(
        symmetric.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
    )
    lower, upper = scipy.sparse.csc_array(found.L), scipy.sparse.csc_array(found.U)
    return Factors(lower, upper, found.perm_r.astype(np.int32), found.perm_c.astype(np.int32))


@numba.njit(cache=True, nogil=True)
def _solve_lower(bounds, rows, values, x):  # type: ignore[no-untyped-def]
    for j in range(len(x)):
        for p in range(bounds[j], bounds[j + 1]):
            i = rows[p]
            if i > j:
                for k in range(x.shape[1]):
                    x[i, k] -= values[p] * x[j, k]


@numba.njit(cache=True, nogil=True)
def _solve_upper(bounds, rows, values, x):  # type: ignore[no-untyped-def]
    for j in range(len(x) - 1, -1, -1):
        for p in range(bounds[j], bounds[j + 1]):
            if rows[p] == j:
                for k in range(x.shape[1]):
                    x[j, k] /= values[p]
        for p in range(bounds[j], bounds[j + 1]):
            i = rows[p]
            if i < j:
                for k in range(x.shape[1]):
                    x[i, k] -= values[p] * x[j, k]
