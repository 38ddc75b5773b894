"""Options from YAML files, mappings and shipped names: frozen, checked, refused with a hint.

`Options` is the base of every options class. `resolve_options` builds one from whatever names a
configuration: a shipped name, a file, a mapping or options that exist already.
"""

import os
import reprlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveInt,
    ValidationError,
)

from tofcorr.errors import ConfigError, Kind, did_you_mean
from tofcorr.files import open_regular, reading

LARGEST_NUMBER = 1e12
"""Largest number read from a file, in the file's own unit. Chosen: a hundred times the fastest
modulation of light, 10 GHz, which is the largest quantity here; its cube still fits a float32."""
SMALLEST_POSITIVE = LARGEST_NUMBER**-1
"""Smallest positive number read where zero is not allowed, in the file's own unit. The reciprocal
of `LARGEST_NUMBER`: nothing that is divided by it overflows."""
LARGEST_DEGREE = 30
"""Highest power of a polynomial (no unit). Chosen: scaled powers above it differ by less than
noise, and a degree of a million fills the memory."""
STRAY = 0.001
"""Share of values that may lie beyond either end of their range (no unit). Chosen: gross errors are
rarer, and a few pixels must not widen the range in which a correction is valid."""
FADE = 0.1
"""Share of the half width of a range within which what was learned fades to zero beyond it. Set by
hand: short against the range, and long enough for a smooth step."""
LARGEST_SIDE = 1_000_000
"""Largest width or height of an image, pixels. Set by hand: more than any image sensor has."""


def not_a_truth_value(value: object) -> object:
    """Refuse true and false, which Python takes for 1 and 0."""
    if isinstance(value, bool):
        # pydantic reports a ValueError; a TypeError would pass through it.
        raise ValueError("expected a number, not true or false")  # noqa: TRY004
    return value


def among(names: Collection[str], what: str) -> AfterValidator:
    """Return the check that a text is one of some names; `what` says what they are."""

    def check(name: str) -> str:
        if name not in names:
            raise ValueError(f"'{name}' is no {what}; known: {', '.join(names)}")
        return name

    return AfterValidator(check)


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    """Refuse a range whose upper end comes first."""
    if ends[0] > ends[1]:
        raise ValueError("expected the lower end first")
    return ends


# Text is passed on to the number parser: YAML 1.1 reads 20.0e6 (no sign) as text.
FiniteNumber = Annotated[float, BeforeValidator(not_a_truth_value), Field(allow_inf_nan=False)]
Number = Annotated[FiniteNumber, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
PositiveNumber = Annotated[FiniteNumber, Field(ge=SMALLEST_POSITIVE, le=LARGEST_NUMBER)]
NonNegativeNumber = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Range = Annotated[tuple[Number, Number], AfterValidator(_ascending)]
Vector3 = tuple[Number, Number, Number]
Degree = Annotated[PositiveInt, Field(le=LARGEST_DEGREE)]
Size = Annotated[int, BeforeValidator(not_a_truth_value), Field(gt=0, le=LARGEST_SIDE)]


class Options(BaseModel):
    """Base of every options class: immutable; an unknown key is an error.

    Attributes:
        config_folder: Folder below `configs/` that holds the shipped files of this class; empty
            where none is shipped. A property of the class, not a key of the file.
    """

    model_config = ConfigDict(
        frozen=True, defer_build=True, extra="forbid", arbitrary_types_allowed=False
    )

    config_folder: ClassVar[str] = ""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str, kind: Kind = ConfigError) -> Self:
        """Check `values` and build the options.

        Args:
            values: Keys and values, as YAML gives them.
            where: What to call the source in an error message, usually the file.
            kind: The error to raise; that of a broken recording or calibration is another one.

        Raises:
            TofcorrError: Of kind `kind`: a key is unknown or missing, or a value is not allowed.
        """
        with refused_in_words(cls, where, kind):
            return cls.model_validate(values)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for YAML or JSON."""
        return self.model_dump(mode="json")


class OpenOptions(Options):
    """Base of what is read of a file to which other tools add keys: these are ignored."""

    model_config = ConfigDict(extra="ignore")


OptionsT = TypeVar("OptionsT", bound=Options)


_LONGEST = 240
"""Longest piece of a file's text that a message repeats, characters. Set by hand: three lines of a
terminal."""


def one_line(text: str, longest: int = _LONGEST) -> str:
    """Return text of a file for a message: in one line, and of bounded length.

    Args:
        text: What the file holds, or what a library says of it.
        longest: Characters that are kept.
    """
    flat = "".join(one if one.isprintable() else " " for one in text)
    return flat if len(flat) <= longest else flat[: longest - 3] + "..."


@contextmanager
def refused_in_words(cls: type[BaseModel], where: str, kind: Kind = ConfigError) -> Iterator[None]:
    """Refuse, in words, values that do not fit a class.

    Args:
        cls: The options class whose validation the block asks for; its keys serve as hints.
        where: What to call the source of the values, usually the file.
        kind: The error to raise.
    """
    try:
        yield
    except ValidationError as error:
        # More than five would hide the first, which often causes the others.
        faults = "; ".join(_one(detail, cls) for detail in error.errors()[:5])
        raise kind(f"{where}: {faults}") from None


def _one(detail: Mapping[str, Any], cls: type[BaseModel]) -> str:
    path = one_line(".".join(str(part) for part in detail["loc"]) or "the file")
    if detail["type"] == "extra_forbidden":
        hint = did_you_mean(str(detail["loc"][-1]), _known_keys(cls, set()))
        return f"'{path}' is not a known key.{hint}"
    if detail["type"] == "missing":
        return f"'{path}' is missing."
    message = one_line(detail["msg"].removeprefix("Value error, "), 3 * _LONGEST)
    if not detail["loc"]:  # Of all entries together; they would not fit.
        return f"{message}."
    return f"'{path}': {message} (got {_shown(detail['input'])})."


def _shown(value: object) -> str:
    """Return `value` as text of bounded length, however deep or long a file made it."""
    try:
        return one_line(reprlib.repr(value))
    except ValueError:  # Python does not print integers of more than 4300 digits.
        return "a very long number"


def _known_keys(kind: Any, seen: set[type]) -> list[str]:  # noqa: ANN401 - any annotation
    """Collect the keys of the options classes in an annotation, and of those nested in them."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return [key for part in getattr(kind, "__args__", ()) for key in _known_keys(part, seen)]
    fields = {} if kind in seen else kind.model_fields
    seen.add(kind)
    nested = [key for one in fields.values() for key in _known_keys(one.annotation, seen)]
    return [*fields, *nested]


_MOST_BYTES = 16_000_000
"""Largest file read, bytes. A simulator with one fixed-pattern value for each pixel of a VGA camera
takes 5 MB, the largest file that tofcorr itself writes."""

_MOST_NODES = 1_000_000
"""Most keys, values and lists of a document, with every alias written out. The same simulator has
0.3 million. Aliases of aliases ("billion laughs") double the number with every line."""
_TOO_MANY = f"more than {_MOST_NODES} values once its aliases are written out"

_DEEPEST = 100
"""Most levels of lists and mappings inside each other. Ten times those of the deepest shipped
configuration; the fast parser calls itself for every level and would overflow its stack."""

# The parser of libyaml is ten times as fast as the one in Python, which needs 12 s for a list of
# 300 000 numbers. Not every installation of PyYAML has it.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# And its writer four times as fast.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
# PyYAML lets more than its own error through: a tag such as !!bool before a value that it does
# not fit ends in a KeyError, IndexError or AttributeError.
_NOT_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)


def read_mapping(path: Path, kind: Kind = ConfigError) -> Mapping[str, Any]:
    """Read the keys and values of one YAML file.

    Raises:
        TofcorrError: Of kind `kind`: the file cannot be read, or holds something else.
    """
    values = parse_yaml(read_text(path, kind), str(path), kind)
    if not isinstance(values, Mapping):
        raise kind(f"{path}: expected keys and values, got {type(values).__name__}.")
    return values


def read_text(path: Path, kind: Kind = ConfigError, most_bytes: int = _MOST_BYTES) -> str:
    """Return the text of a file of bounded size.

    Raises:
        TofcorrError: Of kind `kind`: the file is missing, unreadable, too large or not UTF-8.
    """
    try:
        with reading(path, kind), open_regular(path, most_bytes) as file:
            return file.read().decode("utf-8")
    except UnicodeDecodeError as error:
        raise kind(f"{path}: cannot be read as text ({error}).") from None


def parse_yaml(text: str, where: str, kind: Kind = ConfigError) -> Any:  # noqa: ANN401
    """Return the value of YAML text.

    Args:
        text: One document.
        where: What to call the source in an error message.
        kind: The error to raise.

    Raises:
        TofcorrError: Of kind `kind`: the text is not YAML, or its aliases expand to too much.
    """
    depth = 0
    try:
        # Refuses control characters already.
        for number, event in enumerate(yaml.parse(text, Loader=_LOADER)):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                said = f"lists and mappings nested more than {_DEEPEST} levels deep"
                raise kind(f"{where}: {said} in line {event.start_mark.line + 1}.")
            if number > 2 * _MOST_NODES:  # Each begins, and may end.
                raise kind(f"{where}: {_TOO_MANY}.")
        loader = _LOADER(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _size(node, {}, where)
        return loader.construct_document(node)
    except ConfigError as error:
        raise kind(str(error)) from None
    except _NOT_YAML as error:
        in_one_line = one_line(" ".join(str(error).split()))
        raise kind(f"{where}: not valid YAML: {in_one_line}") from None


def dump_yaml(values: Mapping[str, Any], last: str = "") -> str:
    """Return `values` as YAML text, keys in the order given.

    Args:
        values: Plain values.
        last: A key that a reader needs, and which is written last: a copy of the text that was cut
            short is then refused.
    """
    ordered = {key: value for key, value in values.items() if key != last}
    ordered |= {last: values[last]} if last else {}
    return yaml.dump(ordered, Dumper=_DUMPER, sort_keys=False, allow_unicode=True, width=100)


def _size(node: yaml.Node, sizes: dict[int, int], where: str) -> int:
    """Return how many values an entry means, aliases written out, before any of it is built.

    Args:
        node: The entry.
        sizes: The number found of each entry; 0 while it is counted.
        where: What to call the source in an error message.

    Raises:
        ConfigError: It means too much or has no end; or a key stands twice in a mapping, of which
            YAML would silently take the last.
    """
    known = sizes.get(id(node))
    if known == 0:
        line = node.start_mark.line + 1
        raise ConfigError(f"{where}: the alias in line {line} repeats the entry that holds it.")
    if known:
        return known
    size, keys, sizes[id(node)] = 1, set[str](), 0
    for child in node.value if isinstance(node, yaml.CollectionNode) else ():
        key = child[0] if isinstance(child, tuple) else None
        if isinstance(key, yaml.ScalarNode) and key.value != "<<":  # A merge may repeat.
            if key.value in keys:
                said = f"the key '{one_line(key.value)}' in line {key.start_mark.line + 1}"
                raise ConfigError(f"{where}: {said} stands twice.")
            keys.add(key.value)
        for part in child if isinstance(child, tuple) else (child,):
            size += _size(part, sizes, where)
        if size > _MOST_NODES:
            raise ConfigError(f"{where}: {_TOO_MANY}.")
    sizes[id(node)] = size
    return size


def resolve_options(
    cls: type[OptionsT],
    config: str | Path | Mapping[str, Any] | Options,
    changes: Sequence[str] = (),
) -> OptionsT:
    """Return the options that `config` names, with single values changed.

    Args:
        cls: The options class wanted.
        config: The name of a shipped configuration (`"ea"`) or a file, if text; a file, if a
            `Path`; otherwise keys and values, or options of `cls`.
        changes: `dotted.key=value`, such as `solver.max_iterations=30` or
            `model.terms.0.degree=4`; values are YAML, and an entry of a list is named by its index
            from zero.

    Raises:
        ConfigError: No such configuration, an unknown key, a value that is not allowed, or a
            change of another form or that leads into a value that has no entries.
    """
    if isinstance(config, cls) and not changes:
        return config
    values, where = _values_of(cls, config)
    defaults = values
    if changes:
        where += " with " + one_line(", ".join(changes))
        # For a change that leads into a mapping or list that `values` leaves out.
        defaults = _with_defaults(cls, values)
    for change in changes:
        key, equals, text = change.partition("=")
        names = key.split(".")
        shown = f"'{one_line(change)}'"
        if not equals or not all(names):
            raise ConfigError(f"{shown}: expected KEY=VALUE, such as solver.max_iterations=30.")
        values = _replaced(values, defaults, names, parse_yaml(text, shown))
    return cls.from_mapping(values, where)


def _values_of(
    cls: type[Options], config: str | Path | Mapping[str, Any] | Options
) -> tuple[Mapping[str, Any], str]:
    """Return keys and values, and what to call their source in an error message."""
    if isinstance(config, Options):
        if not isinstance(config, cls):
            raise ConfigError(f"expected {cls.__name__}, got {type(config).__name__}.")
        return config.to_mapping(), cls.__name__
    if isinstance(config, Mapping):
        return config, "the configuration"
    if isinstance(config, str):
        config = shipped_file(config, cls.config_folder)
    return read_mapping(config), str(config)


def _with_defaults(cls: type[Options], values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return all keys with their values or defaults; only `values` if they do not fit `cls`."""
    try:
        return cls.from_mapping(values, "").to_mapping()
    except ConfigError:
        return values


def _replaced(here: Any, default: Any, names: list[str], value: object, above: str = "") -> Any:  # noqa: ANN401 - any YAML value
    """Return a value with the entry at `names` below it replaced; `above` leads to it."""
    if not names:
        return value
    here = default if here is None else here
    listed, (name, *below) = isinstance(here, list | tuple), names
    where = ".".join(filter(None, (above, name)))
    if not listed and not isinstance(here, Mapping | None):
        said = one_line(f"'{where}': '{above}' is the value {here!r}, ")
        raise ConfigError(f"{said}which has no entries.")
    entries, within = _entries(here), _entries(default)
    key = int(name) if listed and name.isdecimal() else name
    if listed and key not in entries:
        span = f"0 to {len(here) - 1}" if here else "none: it is empty"
        said = one_line(f"'{where}': '{above}' is a list")
        raise ConfigError(f"{said}; its entries are {span}.")
    entries[key] = _replaced(entries.get(key), within.get(key), below, value, where)
    return list(entries.values()) if listed else entries


def _entries(value: object) -> dict[Any, Any]:
    listed = dict(enumerate(value)) if isinstance(value, list | tuple) else {}
    return dict(value) if isinstance(value, Mapping) else listed


def configs_folder() -> Path:
    """Return the folder of the shipped configurations.

    An installed package holds it as `tofcorr/configs`; in a checkout it stands beside `tofcorr`.
    """
    package = Path(__file__).resolve().parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def shipped_names(folder: str) -> list[str]:
    """Return the names of the configurations shipped for `folder`, such as `ea` for `train`."""
    return sorted(path.stem for path in (configs_folder() / folder).glob("*.yaml"))


def is_shipped_name(text: str, folder: str) -> bool:
    """Say whether `text` names a configuration shipped for `folder`."""
    return bool(folder) and text in shipped_names(folder)


def shipped_file(text: str, folder: str) -> Path:
    """Return the file that `text` means: a shipped name first, otherwise a path.

    A name comes first so that a folder `ea` of results does not hide the configuration `ea`;
    `./ea` means the file.

    Args:
        text: What the user gave.
        folder: Folder below `configs/` where its names stand; empty: only paths.

    Raises:
        ConfigError: It is neither a name nor a file.
    """
    if is_shipped_name(text, folder):
        return configs_folder() / folder / f"{text}.yaml"
    path = Path(text)
    if not folder or os.path.lexists(path):
        return path
    names = shipped_names(folder)
    said = f"{text}: neither a file nor a configuration shipped for '{folder}'."
    raise ConfigError(f"{said}{did_you_mean(path.stem, names)} Shipped: {', '.join(names)}.")
