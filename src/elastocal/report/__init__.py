"""Results for people: as text, as self-contained HTML pages, and in a notebook.

A view says what a result holds, as `blocks`, which `renderers` show as text and as HTML; `figures`
and `arm_view` draw.  What a result is worth is judged where it is made, as findings.
"""
