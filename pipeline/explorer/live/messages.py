"""Check the messages of the page that request live computations; reject an invalid one with a sentence.

A message is a JSON object with an ``id`` of the page's choice and ``do``, the name of a job; see the classes
here. No field of a message names a file.
"""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from pipeline.explorer import RequestError
from pipeline.products.product import STRICT

MOST_BYTES = 65_536
"""Longest message [bytes]."""

MOST_RESOLUTION, LEAST_RESOLUTION = 512, 16
"""Finest and coarsest slice [cells along a side]."""

MOST_NOISE = 10.0
"""Strongest noise on a start [scales over the square root of a second]."""

Name = Annotated[str, Field(min_length=1, max_length=200)]
Values = Annotated[dict[Name, float], Field(max_length=200)]
Pair = tuple[float, float]


class Message(BaseModel):
    """Base of all messages of the page: strict types, no unknown keys, no NaN, no infinity."""

    model_config = STRICT


class Job(Message):
    """Message that requests a job, with a number `id` that the page has chosen."""

    id: int = Field(ge=0, le=2**53)


class StartRequest(Job):
    """Message that requests to integrate one initial state and to name the attractor that it reaches."""

    do: Literal["start"]
    parameters: Values = {}
    frequency: float | None = Field(None, gt=0)
    state: Values = {}
    periods: int | None = Field(None, ge=1, le=20_000)  # drive periods or returns
    # strength of white noise on the rates, in units of their scales over the square root of a second. With noise
    # no attractor is named.
    noise: float = Field(0.0, ge=0, le=MOST_NOISE)
    seed: int = Field(0, ge=0, le=2**53)  # seed of the noise


class SliceRequest(Job):
    """Message that requests the attractors that the initial states of a plane reach."""

    do: Literal["slice"]
    parameters: Values = {}
    frequency: float | None = Field(None, gt=0)
    plane: tuple[Name, Name]
    ranges: tuple[Pair, Pair]
    fixed: Values = {}
    resolution: int = Field(64, ge=LEAST_RESOLUTION, le=MOST_RESOLUTION)


class CellPoint(Message):
    """Reference to a section point of a cell of the run."""

    cell: int = Field(ge=0, le=2**53)
    point: int = Field(0, ge=0, le=2**53)


class KeptOrbit(Message):
    """Reference to an orbit that an earlier answer has sent."""

    orbit: int = Field(ge=0, le=2**53)


class FollowRequest(Job):
    """Message that requests to follow a periodic orbit to another parameter value."""

    do: Literal["follow"]
    origin: CellPoint | KeptOrbit = Field(alias="from")
    parameter: Name
    value: float


class Region(Message):
    """Region that the user has selected on the page: intervals of parameters or of initial states."""

    x: Pair  # x, y: intervals in the units of the cube
    y: Pair | None = None
    # names of what `x` and `y` are intervals of: axes of the cube, or states of the starts; by default `x` is of
    # the axis that is walked, or of the first. What is neither, such as a diagram's vertical axis, is left as it
    # was.
    axes: tuple[Name, Name | None] | None = None
    # index on each other axis that the new run is to have one value of
    at: Annotated[dict[Name, int], Field(max_length=200)] = {}


class RunRequest(Job, Region):
    """Message that requests a new run for a selected region."""

    do: Literal["run"]


class CancelRequest(Job):
    """Message that requests to cancel a job."""

    do: Literal["cancel"]
    job: int = Field(ge=0, le=2**53)


Request = StartRequest | SliceRequest | FollowRequest | RunRequest | CancelRequest

_READER: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="do")])


def read_request(text: str | bytes) -> Request:
    """Read and check a message of the page; raise RequestError with one sentence if it is invalid."""
    if len(text) > MOST_BYTES:
        raise RequestError(f"the message has {len(text)} bytes; the limit is {MOST_BYTES}.")
    try:
        return _READER.validate_json(text)
    except ValidationError as error:
        raise RequestError(sentence_of(error), number_in(text)) from None


def read_region(text: bytes) -> Region:
    """Read and check a region of the page; raise RequestError if it is invalid."""
    try:
        return Region.model_validate_json(text)
    except ValidationError as error:
        raise RequestError(sentence_of(error)) from None


def sentence_of(error: ValidationError) -> str:
    """Return one sentence about the first mistake in a message."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    jobs = {"start", "slice", "follow", "run", "cancel"}
    if str(first["type"]).startswith("union_tag"):
        return "do: must be start, slice, follow, run or cancel."
    place = ".".join(str(part) for part in first["loc"] if str(part) not in jobs)[:200]
    reason = str(first["msg"])[:300].rstrip(".")
    return f"{place}: {reason}." if place else f"the message cannot be read: {reason}."


def number_in(text: str | bytes) -> int | None:
    """Return the ``id`` of an invalid message; None if it has no valid ``id``."""
    try:
        number = json.loads(text)["id"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return number if type(number) is int and 0 <= number <= 2**53 else None
