"""Every number of the parameters is bounded where it is read, and no key has a default."""

import typing
from typing import Annotated, Any

import pytest
from pydantic import Field

import stages
from pipeline.store import params
from tests.house import ROOT


def unbounded(kind: Any, place: str, limits: tuple = ()) -> list[str]:
    """The places in a type where a number has no lower or no upper bound, or a key has a default other
    than None."""
    if typing.get_origin(kind) is Annotated:
        kind, *extra = typing.get_args(kind)
        limits = (*limits, *(limit for item in extra for limit in getattr(item, "metadata", [item])))
        return unbounded(kind, place, limits)
    if isinstance(kind, type) and issubclass(kind, params.Section):
        sentences = []
        for name, field in kind.model_fields.items():
            # left out is not there: None, an empty list and false are no values
            if not field.is_required() and field.default not in (None, [], False):
                sentences.append(f"{place}.{name} has a default")
            sentences += unbounded(field.annotation, f"{place}.{name}", tuple(field.metadata))
        return sentences
    if kind in (int, float):
        ends = {
            end for end in ("ge", "gt", "le", "lt") for one in limits if getattr(one, end, None) is not None
        }
        sides = {"lower": {"ge", "gt"}, "upper": {"le", "lt"}}
        return [f"{place} has no {side} bound" for side, some in sides.items() if not ends & some]
    union = typing.get_origin(kind) in (typing.Union, typing.get_origin(int | None))
    arguments = [] if typing.get_origin(kind) is typing.Literal else typing.get_args(kind)
    return [item for argument in arguments for item in unbounded(argument, place, limits if union else ())]


@pytest.mark.parametrize("section", stages.SECTIONS)
def test_every_number_of_a_section_is_bounded(section):
    assert unbounded(stages.model(section), section) == []


def test_a_number_without_bounds_and_a_default_are_seen():
    class Inner(params.Section):
        gain: float = Field(ge=0)

    class Outer(params.Section):
        seed: int
        good: int = Field(ge=0, le=9)
        several: tuple[Annotated[float, Field(gt=0, lt=1)], ...]
        loose: list[float] = Field(min_length=1)
        maybe: int | None = Field(ge=0, le=9)
        method: typing.Literal[1, 2]
        inner: list[Inner]
        other: bool = True

    assert unbounded(Outer, "learn") == [
        "learn.seed has no lower bound",
        "learn.seed has no upper bound",
        "learn.loose has no lower bound",
        "learn.loose has no upper bound",
        "learn.inner.gain has no upper bound",
        "learn.other has a default",
    ]


def test_the_owner_of_a_machine_has_few_numbers_to_set():
    def leaves(entries) -> int:
        return sum(map(leaves, entries.values())) if isinstance(entries, dict) and entries else 1

    owner, expert = map(leaves, params.files(ROOT / "params.yaml").values())
    assert owner <= 63 and expert > 4 * owner
