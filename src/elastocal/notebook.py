"""Results that show themselves in a notebook: a table, figures, a data frame.

How a result looks is known by `elastocal.report`, which lies above the packages whose results it
shows.  A result therefore does not import its views; it asks for them by name when they are wanted,
as one asks for a plug-in.  Import order, start-up time and the layers stay as they are.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

VIEWS = "elastocal.report.notebook"


class ForNotebooks:
    """Gives a result `__str__`, `_repr_html_`, `plot` and `to_dataframe`."""

    def __str__(self) -> str:
        """The result as the command line prints it: tables and sentences."""
        return str(_view(self).text(self))

    def _repr_html_(self) -> str:
        """The result as HTML, which notebooks show of themselves; text of the user is escaped."""
        return str(_view(self).html(self))

    def plot(self, kind: str | None = None, interactive: bool = False) -> Any:
        """A figure of the result: matplotlib's Figure, or plotly's where `interactive`.

        `kind` chooses among the result's figures; None takes the first.  Raises InputError for
        another kind, naming those that there are.
        """
        return _view(self).plot(self, kind, interactive)

    def to_dataframe(self) -> pd.DataFrame:
        """The result's main table as a pandas data frame; units stand in the column names."""
        return _view(self).frame(self)


def _view(result: object) -> Any:
    return import_module(VIEWS).view_of(result)
