"""Prior knowledge of parameters: data sheets, an earlier calibration, a sister robot."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import InputError, require
from elastocal.text import did_you_mean, listed, quoted

Array = NDArray[np.float64]

KEYS = ("mean", "std")


@dataclass(frozen=True)
class GaussianPrior:
    """x[names] ~ N(mean, covariance): mean (k,) and covariance (k, k) in the parameters' units.

    Raises InputError where the numbers are not finite or the covariance not positive definite.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        k = len(self.names)
        require(len(set(self.names)) == k, f"the prior names a parameter twice: {self.names}")
        require(
            self.mean.shape == (k,) and self.covariance.shape == (k, k),
            f"a prior of {k} parameters needs {k} means and a {k} × {k} covariance; found shapes "
            f"{self.mean.shape} and {self.covariance.shape}",
        )
        finite = np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()
        require(bool(finite), "the prior's means and covariance must be finite")
        self._root()

    @classmethod
    def independent(
        cls, names: Sequence[str], mean: Sequence[float] | Array, std: Sequence[float] | Array
    ) -> GaussianPrior:
        """x_i ~ N(mean_i, std_i²), independent of each other."""
        spread = np.asarray(std, dtype=float)
        for name, value in zip(names, spread, strict=True):
            require(
                bool(np.isfinite(value) and value > 0),
                f"prior of {quoted(name)}: std must be positive and finite, found {value}",
            )
        return cls(tuple(names), np.asarray(mean, dtype=float), np.diag(spread**2))

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> GaussianPrior:
        """From {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}, …}, in SI units."""
        require(bool(table), "the prior is empty; name at least one parameter")
        means: list[float] = []
        stds: list[float] = []
        for name, entry in table.items():
            where = f"prior of {quoted(name)}"
            require(
                isinstance(entry, Mapping),
                f"{where}: expected {{ mean = …, std = … }}, found {quoted(entry)}",
            )
            nested = [f'"{name}.{key}"' for key in entry if isinstance(entry[key], Mapping)]
            require(not nested, f"{where}: write the full name in quotes: {listed(nested)}")
            for key in entry:
                require(key in KEYS, f"{where}: unknown key {quoted(key)}{did_you_mean(key, KEYS)}")
            for key, target in (("mean", means), ("std", stds)):
                require(key in entry, f"{where}: '{key}' is missing")
                value = entry[key]
                require(
                    isinstance(value, int | float) and not isinstance(value, bool),
                    f"{where}: '{key}' must be a number, found {quoted(value)}",
                )
                target.append(float(value))
        return cls.independent(tuple(table), means, stds)

    @classmethod
    def from_toml(cls, path: Path) -> GaussianPrior:
        """From a file of lines `"joint2.compliance" = { mean = 2.9e-7, std = 3e-8 }`."""
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path}: cannot read the prior ({error.strerror})") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: not a TOML file: {error}") from None
        try:
            return cls.from_dict(table)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def rows(self, names: Sequence[str]) -> tuple[Array, Array]:
        """P (k, p) and target (k,) with |target − P x|² = (x − mean)ᵀ covariance⁻¹ (x − mean).

        Raises InputError for a name that is not among the parameters `names` (p,).
        """
        position = {name: i for i, name in enumerate(names)}
        for name in self.names:
            require(
                name in position,
                f"the prior names {quoted(name)}, which is not a parameter"
                f"{did_you_mean(name, position)}; there are {listed(position)}",
            )
        root = self._root()
        P = np.zeros((len(self.names), len(position)))
        P[:, [position[name] for name in self.names]] = root
        return P, root @ self.mean

    def _root(self) -> Array:
        """L⁻¹ of the Cholesky factor; by standardised parameters, whose units are alike."""
        std = np.sqrt(np.abs(np.diag(self.covariance)))
        try:
            require(bool((std > 0).all()), "")
            L = linalg.cholesky(self.covariance / np.outer(std, std), lower=True)
        except (linalg.LinAlgError, InputError):
            raise InputError(
                "the prior's covariance is not positive definite; leave out parameters that are "
                "known exactly (fix them) or that repeat another one"
            ) from None
        return linalg.solve_triangular(L, np.diag(1 / std), lower=True)


def share_of_prior(cofactor: Array, P: Array) -> Array:
    """Share (p,) of each estimate's information that the prior gave, 0 to 1.

    With V = (H_data + H_prior)⁻¹ (on the active face), V = V H_data V + V H_prior V: the posterior
    variance splits into what the noise and what the prior's uncertainty pass on, and the share is
    (V H_prior V)_ii / V_ii; for a single parameter τ⁻²/(τ⁻² + σ⁻²).  NaN where V_ii = 0: a value
    that the constraints fix.
    """
    passed = ((P @ cofactor) ** 2).sum(axis=0)
    variance = np.diag(cofactor)
    share = np.full(len(variance), np.nan)
    return np.divide(passed, variance, out=share, where=variance > 0)
