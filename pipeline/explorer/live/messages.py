"""Read the page's live requests: check, bound, or refuse each with one sentence.

A message is a JSON object with an ``id`` of the page's choice and ``do``, the name of a job; see the classes
here. No field of a message names a file.
"""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

MOST_BYTES = 65_536
"""Longest message [bytes]."""

MOST_RESOLUTION, LEAST_RESOLUTION = 512, 16
"""Finest and coarsest slice [cells along a side]."""

MOST_PERIODS = 20_000
"""Longest start [drive periods or returns]."""

Name = Annotated[str, Field(min_length=1, max_length=200)]
Values = Annotated[dict[Name, float], Field(max_length=200)]
Pair = tuple[float, float]


class RequestError(ValueError):
    """A message that cannot be accepted.

    Attributes
    ----------
    job : int or None
        Its ``id``, if that could be read.
    """

    def __init__(self, sentence: str, job: int | None = None) -> None:
        super().__init__(sentence)
        self.job = job


class Message(BaseModel):
    """The base of all messages: strict types, no unknown keys, no NaN and no infinity."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class Job(Message):
    """A job with the page's number `id`."""

    id: int = Field(ge=0, le=2**53)


class StartRequest(Job):
    """A request to integrate a start and tell where it ends."""

    do: Literal["start"]
    parameters: Values = {}
    frequency: float | None = Field(None, gt=0)
    state: Values = {}
    periods: int | None = Field(None, ge=1, le=MOST_PERIODS)


class SliceRequest(Job):
    """A request for the ends of the starts of a plane."""

    do: Literal["slice"]
    parameters: Values = {}
    frequency: float | None = Field(None, gt=0)
    plane: tuple[Name, Name]
    ranges: tuple[Pair, Pair]
    fixed: Values = {}
    resolution: int = Field(64, ge=LEAST_RESOLUTION, le=MOST_RESOLUTION)


class CellPoint(Message):
    """A kept section of a cell of the cube."""

    cell: int = Field(ge=0, le=2**53)
    point: int = Field(0, ge=0, le=2**53)


class KeptOrbit(Message):
    """An orbit named by an earlier answer."""

    orbit: int = Field(ge=0, le=2**53)


class FollowRequest(Job):
    """A request to follow a periodic orbit to another parameter value."""

    do: Literal["follow"]
    origin: CellPoint | KeptOrbit = Field(alias="from")
    parameter: Name
    value: float


class Region(Message):
    """A part of a run's parameters or starts.

    Attributes
    ----------
    x, y
        Intervals in the units of the cube.
    axes
        Names of what `x` and `y` are intervals of: axes of the cube, or states of the starts; by default
        `x` is of the axis that is walked, or of the first. What is neither, such as a diagram's vertical
        axis, is left as it was.
    at
        Index on each other axis that the new run is to have one value of.
    """

    x: Pair
    y: Pair | None = None
    axes: tuple[Name, Name | None] | None = None
    at: Annotated[dict[Name, int], Field(max_length=200)] = {}


class RunRequest(Job, Region):
    """A request to run the specification of a region."""

    do: Literal["run"]


class CancelRequest(Job):
    """A request to cancel a job."""

    do: Literal["cancel"]
    job: int = Field(ge=0, le=2**53)


Request = StartRequest | SliceRequest | FollowRequest | RunRequest | CancelRequest

_READER: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="do")])


def read_request(text: str | bytes) -> Request:
    """Read a message.

    Raises
    ------
    RequestError
        With one sentence that says what is wrong with it.
    """
    if len(text) > MOST_BYTES:
        raise RequestError(f"the message has {len(text)} bytes; the limit is {MOST_BYTES}.")
    try:
        return _READER.validate_json(text)
    except ValidationError as error:
        raise RequestError(sentence_of(error), number_in(text)) from None


def sentence_of(error: ValidationError) -> str:
    """Return one sentence on the first error."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    jobs = {"start", "slice", "follow", "run", "cancel"}
    if str(first["type"]).startswith("union_tag"):
        return "do: must be start, slice, follow, run or cancel."
    place = ".".join(str(part) for part in first["loc"] if str(part) not in jobs)[:200]
    reason = str(first["msg"])[:300].rstrip(".")
    return f"{place}: {reason}." if place else f"the message cannot be read: {reason}."


def number_in(text: str | bytes) -> int | None:
    """Return the ``id`` of a rejected message; None if it has none."""
    try:
        number = json.loads(text)["id"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return number if type(number) is int and 0 <= number <= 2**53 else None
