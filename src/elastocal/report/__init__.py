"""Results for people: as text, as self-contained HTML pages, and in a notebook.

A view says what a result holds, in words and rows (`identification_view`, `plan_view`,
`diagnosis_view`, `residual_view`, `arm_view`); `terminal`, `page` and `notebook` show it, `figures`
and `residual_figures` draw it.  What a result is worth is judged where it is made, as findings.
"""
