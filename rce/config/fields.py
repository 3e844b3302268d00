"""Declaration of settings: types with their checks, and the texts for options and pages.

A section is a :class:`Section` whose fields carry a :class:`Setting`::

    class MasterSettings(Section):
        http_port: Annotated[Port, Setting("Clients, REST and metrics.", up="http-port")] = 9000

From it come the key of the settings file, the option of the program, the option of ``rce up`` and the entry
on the reference page. It is msgspec, not pydantic: the models of the latter cost each program 15 MB.
"""

from __future__ import annotations

import difflib
import ipaddress
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec
from msgspec import NODEFAULT, Meta, Struct
from msgspec.structs import fields as struct_fields

from rce.config.documents import join
from rce.config.exceptions import Fault
from rce.config.store_address import read_store_address
from rce.masters import split_addresses, split_port
from rce.model import read_cores, read_memory, write_memory

_WORDS = {
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
}
"""msgspec's words for the kinds of values, and those for users."""


class Section(Struct, frozen=True, kw_only=True):
    """Settings that belong together. Instances do not change."""


@dataclass(frozen=True, slots=True)
class Setting:
    """The texts and option names of a setting, beside its type and its default."""

    help: str
    """One sentence, for the program's help, the reference page and the shipped file."""
    option: str | None = None
    """Name of the program's option without dashes; None: the field's name; empty: no option."""
    up: str = ""
    """Name of the option of ``rce up``; empty: none."""
    unset: str = ""
    """Text on the effect while it is not set, where the default does not show it."""
    example: str = ""
    """A value for the shipped file, where the default is none or depends on the machine."""
    alias: str = ""
    """Another key of the settings file that means the same; empty: none."""


@dataclass(frozen=True, slots=True)
class Reader:
    """Reads a value that people may write in several ways; of a list, each of its values."""

    read: Callable[[Any], Any]
    """Raises ValueError if the value is not valid; the text says what is valid."""
    write: Callable[[Any], Any]
    """Writes a value so that :attr:`read` reads the same."""
    metavar: str


@dataclass(frozen=True, slots=True)
class Field:
    """A setting, looked up in its section."""

    name: str
    type: Any
    default: Any
    setting: Setting
    reader: Reader | None

    @property
    def is_flag(self) -> bool:
        """Whether it is on or off."""
        return self.bare is bool

    @property
    def is_list(self) -> bool:
        """Whether it has several values."""
        return getattr(self.bare, "__origin__", None) is tuple

    @property
    def bare(self) -> Any:
        """The type without its annotations."""
        return self.type.__origin__ if hasattr(self.type, "__metadata__") else self.type

    @property
    def metavar(self) -> str:
        """The kind of its value, as help texts show it."""
        if self.reader is not None:
            return self.reader.metavar
        inner = str(get_args(self.bare)[0] if get_args(self.bare) else self.bare)
        words = {"int": "NUMBER", "float": "NUMBER", "Path": "PATH", "bool": "yes|no"}
        return next((word for name, word in words.items() if name in inner), "TEXT")

    @property
    def shown_default(self) -> str:
        """The default as users read it; empty if there is none."""
        if self.setting.unset:
            return self.setting.unset
        if isinstance(self.default, int | float) and not isinstance(self.default, bool):
            return f"{self.default:.10g}" if self.reader is None or not self.default else str(self._plain())
        return ", ".join(self.default) if self.is_list else str(self._plain()).lower()

    def _plain(self) -> Any:
        value = self.write(self.default)
        return int(value) if isinstance(value, float) and value.is_integer() else value

    def read(self, value: Any, *, text: bool = False) -> Any:
        """Read a value of a document, or a text of the command line.

        Raises:
            SettingError: It does not fit.
        """
        try:
            if self.reader is not None:
                value = self._read_each(value) if self.is_list else self.reader.read(value)
            return msgspec.convert(value, self.type, strict=not text, dec_hook=_decode)
        except msgspec.ValidationError as error:
            problem, _, place = str(error).partition(" - at ")
            expected = problem.removeprefix("Expected ").split(", got", 1)[0].replace("`", "")
            word, _, rest = expected.partition(" ")
            problem = f"must be {_WORDS.get(word, word)} {rest}".rstrip()
            found = f", found {value!r:.60}" if isinstance(value, int | float | str) else ""
            raise SettingError(problem + found, place.strip("`").removeprefix("$")) from None
        except SettingError:
            raise
        except ValueError as error:
            raise SettingError(str(error)) from None

    def _read_each(self, values: Any) -> Any:
        assert self.reader is not None
        if not isinstance(values, list | tuple):
            return values
        found = []
        for index, value in enumerate(values):
            try:
                found.append(self.reader.read(value))
            except ValueError as error:
                raise SettingError(str(error), f"[{index}]") from None
        return found

    def write(self, value: Any) -> Any:
        """Return the value in the form of a document."""
        if value is None:
            return None
        write = _plain if self.reader is None else self.reader.write
        return [write(item) for item in value] if isinstance(value, tuple) else write(value)


class SettingError(ValueError):
    """A value does not fit its setting.

    Attributes:
        place: Where in the value, such as ``[0]``; empty for all of it.
    """

    def __init__(self, problem: str, place: str = "") -> None:
        super().__init__(problem)
        self.place = place


@cache
def fields_of(section: type[Section]) -> Mapping[str, Field]:
    """Return the settings of a section, without sections in it, by name."""
    return {field.name: field for field in _fields(section)}


@cache
def sections_of(section: type[Section]) -> Mapping[str, type[Section]]:
    """Return the sections in a section, by name."""
    return {field.name: field.type for field in struct_fields(section) if _is_section(field.type)}


def read_section(
    section: type[Section], data: Any, place: str, faults: list[Fault], others: Collection[str] = ()
) -> dict[str, Any]:
    """Read those values that a document holds.

    Args:
        section: The section's class.
        data: The document, as plain values.
        place: Where it stands, for faults.
        faults: Gets every fault.
        others: Keys that are not for this reader, and are passed over.

    Returns:
        The values that fit; those of sections as dictionaries.
    """
    if data is None:  # a section whose settings are all commented out
        return {}
    if not isinstance(data, dict):
        faults.append(Fault(place, f"must be a mapping, found {data!r:.40}"))
        return {}
    fields, inner = fields_of(section), sections_of(section)
    names = {field.setting.alias: name for name, field in fields.items() if field.setting.alias}
    chosen: dict[str, Any] = {}
    for key, value in data.items():
        here = join(place, key)
        name: Any = names.get(key, key)
        if key in inner:
            chosen[key] = read_section(inner[key], value, here, faults)
        elif name in fields:
            if name != key and name in data:
                faults.append(Fault(here, f"means the same as {name}; give one of them"))
                continue
            try:
                chosen[name] = fields[name].read(value)
            except SettingError as error:
                faults.append(Fault(here + error.place, str(error)))
        elif key not in others:
            close = difflib.get_close_matches(str(key), [*fields, *inner, *others], 1, 0.5)
            faults.append(
                Fault(here, "is not a known key" + (f"; did you mean {close[0]!r}?" if close else ""))
            )
    return chosen


def write_section(settings: Section, base: Section) -> dict[str, Any]:
    """Return the differences to other settings of the same kind, as :func:`read_section` reads them."""
    document: dict[str, Any] = {}
    for name, field in fields_of(type(settings)).items():
        value = getattr(settings, name)
        if value != getattr(base, name):
            document[name] = field.write(value)
    for name in sections_of(type(settings)):
        if inner := write_section(getattr(settings, name), getattr(base, name)):
            document[name] = inner
    return document


def _fields(section: type[Section]) -> Iterator[Field]:
    for field in struct_fields(section):
        if _is_section(field.type):
            continue
        said = getattr(field.type, "__metadata__", ())
        setting = next(each for each in said if isinstance(each, Setting))
        reader = next((each for each in said if isinstance(each, Reader)), None)
        made = field.default_factory is not NODEFAULT
        yield Field(
            field.name, field.type, field.default_factory() if made else field.default, setting, reader
        )


def _is_section(candidate: Any) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, Section)


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, Path) else value


def _decode(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str) and value:
        return Path(value).expanduser()
    raise ValueError("must be the path of a file or folder")


def _read_host(value: Any) -> Any:
    try:
        ipaddress.ip_address(value)
    except ValueError:
        bare = value.replace("-", "").replace(".", "").replace("_", "") if isinstance(value, str) else "?"
        if value and not bare.isalnum():
            raise ValueError(f"must be a host name or an IP address, found {value!r:.60}") from None
    return value


def _read_hosts(value: Any) -> Any:
    if isinstance(value, list | tuple):
        if not value or not all(isinstance(host, str) and split_addresses(host) == (host,) for host in value):
            raise ValueError(f"must be a list of HOST or HOST:PORT, found {value!r:.60}")
        value = ",".join(value)
    for host in split_addresses(value) if isinstance(value, str) else [value]:
        _read_host(split_port(host, 1)[0] if isinstance(host, str) else host)
    return value


def _read_network(value: Any) -> Any:
    try:
        ipaddress.ip_network(value, strict=False)
    except (ValueError, TypeError):
        raise ValueError(
            f"must be an IP address or a network such as 10.0.0.0/8, found {value!r:.60}"
        ) from None
    return value


def _read_finite(value: Any) -> Any:
    try:
        number = float(value) if isinstance(value, int | float | str) else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or isinstance(value, bool):
        raise ValueError(f"must be a number, found {value!r:.60}")
    return number


def choice(kind: type[Enum]) -> Reader:
    """Return the reader of one of several words."""

    def read(value: Any) -> Any:
        words = [str(item.value) for item in kind]
        if value not in words:
            raise ValueError(f"must be one of {', '.join(words)}, found {value!r:.60}")
        return value

    return Reader(read, _plain, "|".join(str(item.value) for item in kind))


def _read_store(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError(f"must be sqlite:FOLDER or etcd://HOST:PORT,..., found {value!r:.60}")  # noqa: TRY004
    read_store_address(value)
    return value


def _same(value: Any) -> Any:
    return value


Host = Annotated[str, Reader(_read_host, _same, "HOST")]
"""A host name or an IP address; empty for none."""
Hosts = Annotated[str, Reader(_read_hosts, _same, "HOST[:PORT],...")]
"""As :data:`Host`, or several, separated by commas or as a list."""
Store = Annotated[str, Reader(_read_store, _same, "STORE")]
"""Where the master's state is, as :func:`rce.config.store_address.read_store_address` reads it."""
Networks = Annotated[tuple[str, ...], Reader(_read_network, _same, "ADDRESS")]
"""IP addresses or networks."""
Port = Annotated[int, Meta(ge=0, le=65535)]
"""A TCP port; 0 takes a free one."""
Finite = Annotated[float, Reader(_read_finite, _same, "NUMBER")]
"""A number, neither infinite nor NaN."""
Seconds = Annotated[float, Meta(ge=0), Reader(_read_finite, _same, "SECONDS")]
Cores = Annotated[float, Reader(read_cores, _same, "CORES")]
"""A share of the processors: cores, or a text such as ``50%``."""
Memory = Annotated[int, Reader(read_memory, write_memory, "MB|SIZE")]
"""Bytes; written in MB, or as a text such as ``8G``."""
