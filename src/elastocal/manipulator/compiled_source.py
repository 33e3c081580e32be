"""The C text of a tape: CasADi's generated code for one row, and a driver that loops over rows.

CasADi writes one function of thousands of statements on one work array.  Compilers need time that
grows faster than a function's length, so its statements are cut into functions; they
stay as CasADi wrote them but for the places where inputs are read and outputs stored.
"""

from __future__ import annotations

import re

import casadi as ca

from elastocal.manipulator.backend_function import row_by_row

# Statements per C function, and rows that pass through one function before the next: the function
# then stays in the first-level cache, and so does most of the work array.  Measured with gcc 12,
# -O2, B of a KR 270 with 63 parameters (14 000 instructions), as compile time and time per row:
# whole 2.4 s and 2.1 µs; 500 × 1 row 2.0 s and 3.5 µs; 500 × 8 2.1 s and 2.2 µs; 200 × 8 1.7 s and
# 1.9 µs; 100 × 16 1.8 s and 2.1 µs; 200 × 32 1.8 s and 2.4 µs.  With 254 parameters (30 000
# instructions): whole 8.4 s and 4.4 µs, 200 × 8 3.8 s and 5.3 µs.  What is short compiles quickly
# in long functions too, which hand on less through the work array: 3600 statements, 100 000 rows,
# on another processor, beside CasADi's code compiled whole at -O3: 200 × 8 0.7 s and 1.24 times its
# time, 1000 × 4 0.8 s and 1.17, 2000 × 4 0.9 s and 1.10.
PIECE, LONG_PIECE = 200, 2000
SHORT = 5000  # statements of a tape that is cut into long pieces
ROWS = 4

_READ = re.compile(r"arg\[(\d+)\]\? arg\[\d+\]\[(\d+)\] : 0")
_STORE = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=")
_STATEMENT = re.compile(r"  (?:w\[\d+\]|out\[\d+\]\[\d+\])=[^;]*;")
_BODY = re.compile(r"static int casadi_f0\([^)]*\) \{\n(.*?)  return 0;\n\}\n", re.DOTALL)

_DRIVER = """
CASADI_SYMBOL_EXPORT long long elastocal_work(void) {{ return {work}; }}

CASADI_SYMBOL_EXPORT void elastocal_rows(long long first, long long last,
    const double* const* inputs, const long long* strides, double* const* outputs, double* work) {{
  static const long long sizes[] = {{{sizes}}};
  const double* in[{rows}][{n_in}];
  double* out[{rows}][{n_out}];
  for (long long row = first; row < last; row += {rows}) {{
    const int n = last - row < {rows} ? (int) (last - row) : {rows};
    for (int r = 0; r < n; r++) {{
      for (int k = 0; k < {n_in}; k++) in[r][k] = inputs[k] + (row + r) * strides[k];
      for (int k = 0; k < {n_out}; k++) out[r][k] = outputs[k] + (row + r) * sizes[k];
    }}
{calls}
  }}
}}
"""
_CALL = "    for (int r = 0; r < n; r++) piece{k}(in[r], out[r], work + r * {registers});"
_PIECE = """
static __attribute__((noinline)) void piece{k}(const double* const* restrict in,
    double* const* restrict out, double* restrict w) {{
{statements}
}}
"""


class UnknownCode(Exception):
    """CasADi's generated code is not written as it is known here."""


def c_source(function: ca.Function) -> str:
    """C text that exports `elastocal_rows` and `elastocal_work`, the doubles of work it takes.

    `elastocal_rows(first, last, inputs, strides, outputs, work)` evaluates rows first ≤ i < last:
    input k of row i is at inputs[k] + i·strides[k], output k's (rows, columns) at
    outputs[k] + i·rows·columns, row by row.  Structural zeros are not stored.

    Raises UnknownCode where CasADi's code is not what is expected.
    """
    generator = ca.CodeGenerator("tape", {"avoid_stack": True})
    generator.add(function)
    text = generator.dump()
    body = _BODY.search(text)
    if body is None:
        raise UnknownCode("no body")
    places = [row_by_row(function.sparsity_out(k)) for k in range(function.n_out())]
    code = _READ.sub(r"in[\1][\2]", body[1])
    code = _STORE.sub(lambda m: f"out[{m[1]}][{places[int(m[1])][int(m[2])]}]=", code)
    statements = [line for line in code.split("\n") if line.strip()]
    strange = next((line for line in statements if not _STATEMENT.fullmatch(line)), None)
    if strange is not None:
        raise UnknownCode(strange.strip())
    registers = function.sz_w()
    length = LONG_PIECE if len(statements) <= SHORT else PIECE
    pieces = [statements[k : k + length] for k in range(0, len(statements), length)]
    helpers = text[: body.start()].replace("casadi_real casadi_", "static casadi_real casadi_")
    parts = [_PIECE.format(k=k, statements="\n".join(p)) for k, p in enumerate(pieces)]
    calls = "\n".join(_CALL.format(k=k, registers=registers) for k in range(len(pieces)))
    sizes = ", ".join(str(function.numel_out(k)) for k in range(function.n_out()))
    driver = _DRIVER.format(
        sizes=sizes or "0",
        rows=ROWS,
        n_in=max(function.n_in(), 1),
        n_out=max(function.n_out(), 1),
        calls=calls,
        work=ROWS * max(registers, 1),
    )
    return "".join([helpers, *parts, driver])
