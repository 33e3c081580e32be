"""CasADi as people call it: Function row by row, `map`, and its C code in a bare C loop."""

from __future__ import annotations

import ctypes
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MAPPED = 10_000  # rows of one call of a mapped function
FLAGS = ("-O3", "-shared", "-fPIC", "-w")
LOOP = """
#include <string.h>
void loop(long long n, double** given, const long long* strides, double** out,
          const long long* widths) {{
  const double* arg[{n_arg}]; double* res[{n_res}]; casadi_int iw[{n_iw}]; double w[{n_w}];
  for (long long i = 0; i < n; i++) {{
    for (int k = 0; k < {n_in}; k++) arg[k] = given[k] + i * strides[k];
    for (int k = 0; k < {n_out}; k++) res[k] = out[k] + i * widths[k];
    tape(arg, res, iw, w, 0);
  }}
}}
"""


def function_of(inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> ca.Function:
    """All numbers of the outputs, zeros included, every subexpression once."""
    return ca.Function("tape", list(inputs), [ca.densify(o) for o in outputs], {"cse": True})


def python_loop(f: ca.Function, arrays: Sequence[Array], n: int) -> list[Array]:
    """One call per row from Python, results written into arrays (n, rows, columns)."""
    results = [np.empty((n, *f.size_out(k))) for k in range(f.n_out())]
    for i in range(n):
        found = f.call([a[i] if a.ndim == 2 else a for a in arrays])
        for result, value in zip(results, found, strict=True):
            result[i] = value
    return results


class Mapped:
    """`Function.map` over MAPPED rows at a time, or fewer where the table is smaller."""

    def __init__(self, f: ca.Function, rows: int) -> None:
        self.f, self.width = f, min(rows, MAPPED)
        self.map = f.map(self.width)

    def __call__(self, arrays: Sequence[Array], n: int) -> list[Array]:
        sizes = [self.f.size_out(k) for k in range(self.f.n_out())]
        results = [np.empty((n, c, r)) for r, c in sizes]
        for first in range(0, n, self.width):
            rows = slice(first, min(first + self.width, n))
            m = rows.stop - rows.start
            mapped = self.map if m == self.width else self.f.map(m)
            given = [a[rows].T if a.ndim == 2 else np.tile(a[:, None], (1, m)) for a in arrays]
            for result, found in zip(results, mapped.call(given), strict=True):
                columns = np.asarray(found).T  # (m · columns, rows): CasADi's are side by side
                result[rows] = columns.reshape(m, *result.shape[1:])
        return [r.transpose(0, 2, 1) for r in results]


class BareC:
    """C that CasADi generates, compiled whole at -O3, one row after the other in a C loop."""

    def __init__(self, f: ca.Function) -> None:
        self.f = f
        sizes = {"n_arg": f.sz_arg(), "n_res": f.sz_res(), "n_iw": max(f.sz_iw(), 1)}
        sizes |= {"n_w": max(f.sz_w(), 1), "n_in": f.n_in(), "n_out": f.n_out()}
        with tempfile.TemporaryDirectory() as folder:
            here = os.getcwd()
            os.chdir(folder)  # CasADi writes to the current folder only
            try:
                f.generate("tape.c", {"with_header": False})
            finally:
                os.chdir(here)
            source = Path(folder, "tape.c")
            source.write_text(source.read_text() + LOOP.format(**sizes))
            library = Path(folder, "bare.so")
            command = [os.environ.get("CC") or "cc", *FLAGS, str(source), "-o", str(library), "-lm"]
            subprocess.run(command, check=True, capture_output=True)
            self.loop = ctypes.CDLL(str(library)).loop
        pointer = ctypes.c_void_p
        self.loop.argtypes = [ctypes.c_longlong, pointer, pointer, pointer, pointer]
        self.loop.restype = None

    def __call__(self, arrays: Sequence[Array], n: int) -> list[Array]:
        results = [np.empty((n, *self.f.size_out(k)[::-1])) for k in range(self.f.n_out())]
        given = [np.ascontiguousarray(a) for a in arrays]
        strides = [a.shape[1] if a.ndim == 2 else 0 for a in given]
        widths = [r.shape[1] * r.shape[2] for r in results]
        self.loop(
            n,
            (ctypes.c_void_p * len(given))(*[a.ctypes.data for a in given]),
            (ctypes.c_longlong * len(given))(*strides),
            (ctypes.c_void_p * len(results))(*[r.ctypes.data for r in results]),
            (ctypes.c_longlong * len(results))(*widths),
        )
        return [r.transpose(0, 2, 1) for r in results]
