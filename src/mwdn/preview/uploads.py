"""Requests to orders: multipart forms with size and time limits, and JSON in their fields."""

import asyncio
import json
from dataclasses import dataclass, field
from typing import Any

from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

from mwdn.errors import ParameterError, UnknownNameError, reason
from mwdn.preview.limits import Limits, RefusedError
from mwdn.preview.result import MEDIA, Look

FIELD_BYTES = 2**14
"""Most bytes of a field that is not a file."""

LOOKS = ("format", "exposure", "white_balance")
"""Names, in a form or a query, of how a picture is wanted."""


@dataclass(frozen=True)
class Form:
    """A form's files and texts by their names."""

    files: dict[str, bytes] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)

    def file(self, name: str) -> bytes:
        """A file that must be there.

        Raises:
            ParameterError: it is missing or empty.
        """
        if name not in self.files:
            raise ParameterError(f"`{name}` must be a file of the form: curl --form {name}=@{name}.png")
        if not self.files[name]:
            raise ParameterError(f"`{name}` is empty (0 bytes). Copy the file from its source again.")
        return self.files[name]

    def json(self, name: str) -> dict[str, Any]:
        """A JSON object, empty if it is missing.

        Raises:
            ParameterError: it is none.
        """
        return parse_object(self.texts.get(name) or "{}", name)

    def flag(self, name: str) -> bool | None:
        """``true`` or ``false``; ``None`` if it is missing.

        Raises:
            ParameterError: it is neither.
        """
        text = self.texts.get(name, "")
        if text not in ("", "true", "false"):
            raise ParameterError(f"`{name}` ({text[:40]!r}) must be true or false.")
        return None if not text else text == "true"


def parse_object(text: str, name: str) -> dict[str, Any]:
    """A JSON object.

    Raises:
        ParameterError: it is none.
    """
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"`{name}` must be JSON: {reason(error)}.") from None
    if not isinstance(value, dict):
        raise ParameterError(f'`{name}` must be a JSON object: `{{"bin": 2}}`.')
    return value


def _refuse_constant(word: str) -> None:
    raise ValueError(f"{word} is no number of JSON")


def parse_number(text: str | None, name: str, default: float) -> float:
    """A number of a form or a query.

    Raises:
        ParameterError: it is none.
    """
    try:
        return float(text) if text else default
    except ValueError:
        raise ParameterError(f"`{name}` ({text and text[:40]!r}) must be a number.") from None


def parse_white_balance(text: str | None) -> Any:  # noqa: ANN401
    """``grey-world``, ``psf`` or three gains with commas; ``camera`` if empty; ``None`` for ``none``.

    Raises:
        ParameterError: none of them.
    """
    if text == "none":
        return None
    if not text:
        return "camera"
    if text in ("camera", "grey-world", "psf"):
        return text
    try:
        gains = tuple(float(gain) for gain in text.split(","))
    except ValueError:
        gains = ()
    if len(gains) != 3:
        raise ParameterError(
            f"`white_balance` ({text[:40]!r}) must be camera, none, grey-world, psf or gains: 1.8,1,1.5"
        )
    return gains


def look_query(request: Request) -> dict[str, str]:
    """Format, exposure and white balance of a picture, as texts, from the query of its address.

    Raises:
        UnknownNameError: the query has another name.
    """
    values = {name: value for name, value in request.query_params.items() if name != "token"}
    for name in values:
        if name not in LOOKS:
            raise UnknownNameError("name of the query", name, LOOKS)
    return values


def parse_look(values: Any) -> Look:  # noqa: ANN401
    """How a picture is wanted, from a form or a query."""
    if values.get("format", "png") not in MEDIA:
        raise ParameterError(f"`format` ({values['format'][:40]}) must be {', '.join(MEDIA)}.")
    return Look(
        format=values.get("format", "png"),
        exposure=parse_number(values.get("exposure"), "exposure", 0.0),
        white_balance=parse_white_balance(values.get("white_balance")),
    )


async def read_form(request: Request, limits: Limits, files: tuple[str, ...], texts: tuple[str, ...]) -> Form:
    """Read a multipart form. `mwdn.preview.guard` has limited its bytes.

    Args:
        request: the request.
        limits: of the server.
        files: names that may be files.
        texts: names that may be texts.

    Raises:
        RefusedError: it does not arrive in time, is no form, or the client has left.
        UnknownNameError: a field has another name.
        ParameterError: a field is given twice, or a file is a text.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip()
    if kind != "multipart/form-data":
        raise RefusedError(415, f"The request must be multipart/form-data, not {kind[:60] or 'without a type'!r}.")
    try:
        async with asyncio.timeout(limits.upload_s):
            async with request.form(
                max_files=len(files), max_fields=len(texts), max_part_size=FIELD_BYTES
            ) as form:  # closes its temporary files
                return await _read_fields(form, files, texts)
    except TimeoutError:
        raise RefusedError(
            408, f"The request did not arrive within {limits.upload_s:g} s, the server's limit."
        ) from None
    except HTTPException as error:
        raise RefusedError(error.status_code, f"The form cannot be read: {error.detail}") from None
    except ClientDisconnect:
        raise RefusedError(400, "The client left before the request was complete.") from None


async def _read_fields(form: FormData, files: tuple[str, ...], texts: tuple[str, ...]) -> Form:
    result = Form()
    for name, value in form.multi_items():
        if name not in (*files, *texts):
            raise UnknownNameError("field", name, [*files, *texts])
        if name in result.files or name in result.texts:
            raise ParameterError(f"`{name}` is given twice. Send one request for each.")
        if isinstance(value, UploadFile) != (name in files):
            raise ParameterError(f"`{name}` must be a {'file' if name in files else 'text'}.")
        if isinstance(value, UploadFile):
            result.files[name] = await value.read()
        else:
            result.texts[name] = value
    return result
