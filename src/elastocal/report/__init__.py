"""Results for people: as text, as self-contained HTML pages, and in a notebook.

A view says what a result holds, as `blocks` (`identification_view`, `plan_view`, `diagnosis_view`,
`smaller_views`, `certificate_view`); `terminal`, `page` and `notebook` show
them, `figures` and `arm_view` draw.  What a result is worth is judged
where it is made, as findings.
"""
