"""What a person wishes of single factors, as values. A wish stands above every other verdict, and can be taken back.

Factors are named by what a person knows of them:

    loops/1700000000.000000000/3    one factor, by its id
    loops                           all of a source
    all                             all but the motion
    loops@1700000000.0,1700000060   of a source, or of all, between two stamps; an end that is left out is open
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Literal

import gtsam

from .errors import BadConfig, SlamError
from .graph import Factor
from .measurement import format_stamp, parse_stamp
from .settle import FAR

Out = Literal["disabled", "removed"]
EVERY = "all"
UNMEANT = frozenset({"motion", "odometry", "imu", "floor"})  # kinds that it does not mean
FACTORS = "a factor's id, a source, 'all', or one of these with @<from>,<to>"


@dataclass(frozen=True, slots=True)
class Wishes:
    """out: what stays out, by id. forced: what enters and stays, whatever a stage says. weights: what information is multiplied by."""

    out: Mapping[str, Out] = field(default_factory=dict)
    forced: frozenset[str] = frozenset()
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def ids(self) -> set[str]:
        return {*self.out, *self.forced, *self.weights}

    def of(self, id_: str) -> tuple[Out | None, bool, float]:
        return self.out.get(id_), id_ in self.forced, self.weights.get(id_, 1.0)


@dataclass(frozen=True, slots=True)
class Edit:
    """Names of factors, as a person gives them."""

    disable: Sequence[str] = ()
    enable: Sequence[str] = ()
    remove: Sequence[str] = ()
    reweight: Mapping[str, float] = field(default_factory=dict)

    def applied(self, wishes: Wishes, factors: Sequence[Factor]) -> Wishes:
        """The wishes with this edit; factors: those that can be named. SlamError where a name fits nothing, or two of its parts clash."""
        out, forced, weights = dict(wishes.out), set(wishes.forced), dict(wishes.weights)
        taken: set[str] = set()

        def ids(names: Iterable[str]) -> list[str]:
            found = list(dict.fromkeys(id_ for name in names for id_ in selected(name, factors)))
            if clash := taken.intersection(found):
                raise SlamError(f"'{min(clash)}' is named twice, for two different things")
            taken.update(found)
            return found

        whats: tuple[tuple[Sequence[str], Out], ...] = ((self.disable, "disabled"), (self.remove, "removed"))
        for names, what in whats:
            for id_ in ids(names):
                out[id_] = what if out.get(id_) != "removed" else "removed"
                forced.discard(id_)
        for id_ in ids(self.enable):
            if out.pop(id_, None) == "removed":
                raise SlamError(f"'{id_}' has been removed; undo brings it back")
            forced.add(id_)
        taken.clear()  # what is enabled may be reweighted in one go
        for name, weight in self.reweight.items():
            weights |= dict.fromkeys(ids([name]), weight)
        return Wishes(out, frozenset(forced), weights)


def edit_of(arguments: Mapping[str, Any]) -> Edit:
    """From plain data: lists of names, and a mapping of names to numbers. BadConfig says what is wrong."""
    if unknown := arguments.keys() - {"disable", "enable", "remove", "reweight"}:
        raise BadConfig(
            f"'{min(unknown)}' is nothing that can be edited; known: disable, enable, remove, reweight"
        )
    lists = {name: arguments.get(name, []) for name in ("disable", "enable", "remove")}
    for name, value in lists.items():
        if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
            raise BadConfig(f"'{name}' is no list of names")
    weights = arguments.get("reweight", {})
    if not isinstance(weights, dict):
        raise BadConfig("'reweight' is no mapping of names to numbers")
    for name, weight in weights.items():
        number = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not (number and isfinite(weight) and weight > 0):
            raise BadConfig(f"'{name}' cannot be reweighted by {weight}: give a positive number")
    if not any((*lists.values(), weights)):
        raise BadConfig("nothing to edit: name what to disable, enable, remove or reweight")
    return Edit(**lists, reweight={name: float(weight) for name, weight in weights.items()})


def weights_of(texts: Iterable[str]) -> dict[str, float]:
    """From `NAME=FACTOR`; BadConfig if one is not of that form."""
    found = {}
    for text in texts:
        name, equals, number = text.rpartition("=")
        try:
            found[name] = float(number)
        except ValueError:
            equals = ""
        if not equals or not name:
            raise BadConfig(f"'{text}' is no reweighting: write NAME=FACTOR, as in loops/1.500000000/0=0.25")
    return found


def selected(name: str, factors: Sequence[Factor]) -> list[str]:
    """The ids of the factors that a name means, in their order. SlamError if there are none."""
    if "/" in name:
        found = [factor.id for factor in factors if factor.id == name]
        if not found:
            raise SlamError(f"there is no factor '{name}'; what became of its message says decision/{name}")
        return found
    source, _, span = name.partition("@")
    begin, end = _span(name, span)
    found = [
        factor.id
        for factor in factors
        if begin <= factor.stamp <= end
        and (factor.source == source or (source == EVERY and factor.kind not in UNMEANT))
    ]
    if not found:
        when = f" between {format_stamp(begin)} and {format_stamp(end)}" if span else ""
        raise SlamError(f"'{name}': there are no factors of '{source}'{when}; name {FACTORS}")
    return found


def _span(name: str, span: str) -> tuple[int, int]:
    begin, _, end = span.partition(",")
    try:
        return parse_stamp(begin) if begin else 0, parse_stamp(end) if end else FAR
    except ValueError as error:
        raise BadConfig(f"'{name}': {error}") from None


def weighted(factor: Factor, weight: float) -> Factor:
    """The factor with its information multiplied; a robust kernel stays around it."""
    if weight == 1.0:
        return factor
    noise = _scaled(factor.factor.noiseModel(), weight)
    return Factor(
        factor.id, factor.kind, factor.factor.cloneWithNewNoiseModel(noise), factor.keys, factor.stamp,
        factor.stamps,
    )  # fmt: skip


def _scaled(noise: Any, weight: float) -> Any:
    if isinstance(noise, gtsam.noiseModel.Robust):
        return gtsam.noiseModel.Robust.Create(noise.robust(), _scaled(noise.noise(), weight))
    return gtsam.noiseModel.Gaussian.Information(weight * noise.information())
