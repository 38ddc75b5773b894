"""Options from YAML files, mappings and shipped names: frozen, checked, refused with a hint.

`Options` is the base of every options class. `resolve_options` builds one from whatever names a
configuration: a shipped name, a file, a mapping or options that exist already.
"""

import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PositiveInt, ValidationError

from tofcorr.errors import ConfigError, TofcorrError

LARGEST_NUMBER = 1e12
"""Largest number read from a file, in the file's own unit. Chosen: a hundred times the fastest
modulation of light, 10 GHz, which is the largest quantity here; its cube still fits a float32."""
SMALLEST_POSITIVE = LARGEST_NUMBER**-1
"""Smallest positive number read where zero is not allowed, in the file's own unit. The reciprocal
of `LARGEST_NUMBER`: nothing that is divided by it overflows."""
LARGEST_DEGREE = 30
"""Highest power of a polynomial (no unit). Chosen: scaled powers above it differ by less than
noise, and a degree of a million fills the memory."""
LARGEST_SIDE = 1_000_000
"""Largest width or height of an image, pixels. Set by hand: more than any image sensor has."""


def not_a_truth_value(value: object) -> object:
    """Refuse true and false, which Python takes for 1 and 0."""
    if isinstance(value, bool):
        # pydantic reports a ValueError; a TypeError would pass through it.
        raise ValueError("expected a number, not true or false")  # noqa: TRY004
    return value


# Text is passed on to the number parser: YAML 1.1 reads 20.0e6 (no sign) as text.
FiniteNumber = Annotated[float, BeforeValidator(not_a_truth_value), Field(allow_inf_nan=False)]
Number = Annotated[FiniteNumber, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
PositiveNumber = Annotated[FiniteNumber, Field(ge=SMALLEST_POSITIVE, le=LARGEST_NUMBER)]
NonNegativeNumber = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Range = tuple[Number, Number]
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
    def from_mapping(
        cls, values: Mapping[str, Any], where: str, kind: type[TofcorrError] = ConfigError
    ) -> Self:
        """Check `values` and build the options.

        Args:
            values: Keys and values, as YAML gives them.
            where: What to call the source in an error message, usually the file.
            kind: The error to raise; that of a broken recording or calibration is another one.

        Raises:
            TofcorrError: Of kind `kind`: a key is unknown or missing, or a value is not allowed.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise kind(in_words(error, cls, where)) from None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for YAML or JSON."""
        return self.model_dump(mode="json")


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


def in_words(error: ValidationError, cls: type[BaseModel], where: str) -> str:
    """Return the faults of `error` in words.

    Args:
        error: Raised by the validation of `cls`.
        cls: The options class; its keys serve as hints.
        where: What to call the source of the values, usually the file.
    """
    # More than five would hide the first, which often causes the others.
    return f"{where}: " + "; ".join(_one(detail, cls) for detail in error.errors()[:5])


def _one(detail: Mapping[str, Any], cls: type[BaseModel]) -> str:
    path = one_line(".".join(str(part) for part in detail["loc"]) or "the file")
    if detail["type"] == "extra_forbidden":
        close = get_close_matches(str(detail["loc"][-1]), _known_keys(cls), n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
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


def _known_keys(cls: type[BaseModel], seen: set[type] | None = None) -> list[str]:
    """Collect the keys of `cls` and of every options class nested in it."""
    seen = set() if seen is None else seen
    if cls in seen:
        return []
    seen.add(cls)
    keys = list(cls.model_fields)
    for field in cls.model_fields.values():
        for nested in _option_classes(field.annotation):
            keys += _known_keys(nested, seen)
    return keys


def _option_classes(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    nested = getattr(annotation, "__args__", ())
    return [found for argument in nested for found in _option_classes(argument)]


_MOST_BYTES = 16_000_000
"""Largest file read, bytes. A simulator with one fixed-pattern value for each pixel of a VGA camera
takes 5 MB, the largest file that tofcorr itself writes."""

_MOST_NODES = 1_000_000
"""Most keys, values and lists of a document, with every alias written out. The same simulator has
0.3 million. Aliases of aliases ("billion laughs") double the number with every line."""

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


def read_yaml(path: Path) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Read one YAML file.

    Raises:
        ConfigError: The file is missing, unreadable, too large or not YAML.
    """
    return parse_yaml(read_text(path), str(path))


def read_mapping(path: Path, kind: type[TofcorrError] = ConfigError) -> Mapping[str, Any]:
    """Read the keys and values of one YAML file.

    Raises:
        TofcorrError: Of kind `kind`: the file cannot be read, or holds something else.
    """
    try:
        values = read_yaml(path)
    except ConfigError as error:
        raise kind(str(error)) from None
    if not isinstance(values, Mapping):
        raise kind(f"{path}: expected keys and values, got {type(values).__name__}.")
    return values


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size.

    Raises:
        ConfigError: The file is missing, unreadable, too large or not UTF-8.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ConfigError(
                f"{path}: larger than {_MOST_BYTES // 10**6} MB, the limit of such a file here."
            )
        return content.decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None


def parse_yaml(text: str, where: str) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Return the value of YAML text.

    Args:
        text: One document.
        where: What to call the source in an error message.

    Raises:
        ConfigError: The text is not YAML, or its aliases expand to too much.
    """
    try:
        _refuse_depth(text, where)
        loader = _LOADER(text)  # Refuses control characters already.
        root = loader.get_single_node()
        if root is None:
            return None
        _refuse_expansion(root, where)
        return loader.construct_document(root)
    except ConfigError:
        raise
    except _NOT_YAML as error:
        in_one_line = one_line(" ".join(str(error).split()))
        raise ConfigError(f"{where}: not valid YAML: {in_one_line}") from None


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


def _refuse_depth(text: str, where: str) -> None:
    """Refuse a document that is nested too deeply, or holds too much, before it is built."""
    depth = 0
    for number, event in enumerate(yaml.parse(text, Loader=_LOADER)):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST:
            raise ConfigError(
                f"{where}: lists and mappings are nested more than {_DEEPEST} levels deep in line "
                f"{event.start_mark.line + 1}."
            )
        if number > 2 * _MOST_NODES:
            raise ConfigError(f"{where}: more than {_MOST_NODES} values; that is no configuration.")


def _refuse_expansion(root: yaml.Node, where: str) -> None:
    """Refuse a document whose aliases, written out, make too many nodes or have no end."""
    sizes: dict[int, int | None] = {}  # By id of the node; None while its children are counted.

    def size(node: yaml.Node) -> int:
        known = sizes.get(id(node), 0)
        if known is None:
            line = node.start_mark.line + 1
            raise ConfigError(f"{where}: the alias in line {line} repeats the entry that holds it.")
        if known:
            return known
        sizes[id(node)] = None
        _refuse_doubled(node, where)
        total = 1 + sum(size(child) for child in _children(node))
        if total > _MOST_NODES:
            raise ConfigError(
                f"{where}: more than {_MOST_NODES} values once its aliases are written out; "
                "the limit keeps a small file from filling the memory."
            )
        sizes[id(node)] = total
        return total

    size(root)


def _refuse_doubled(node: yaml.Node, where: str) -> None:
    """Refuse a key that stands twice in one mapping: YAML would silently take the last."""
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, _ in node.value:
        name = key.value if isinstance(key, yaml.ScalarNode) else None
        if name in seen and name != "<<":
            line = key.start_mark.line + 1
            raise ConfigError(f"{where}: the key '{one_line(name)}' in line {line} stands twice.")
        if name is not None:
            seen.add(name)


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [one for pair in node.value for one in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


def load_options(cls: type[OptionsT], path: Path | str) -> OptionsT:
    """Read `path` as YAML and check it against the options class `cls`.

    Raises:
        ConfigError: The file cannot be read, or does not fit `cls`.
    """
    return cls.from_mapping(read_mapping(Path(path)), str(path))


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
            `model.terms.0.degree=4`; values are YAML.

    Raises:
        ConfigError: No such configuration, an unknown key, or a value that is not allowed.
    """
    if isinstance(config, cls) and not changes:
        return config
    values, where = _values_of(cls, config)
    if changes:
        where += " with " + one_line(", ".join(changes))
        values = apply_changes(values, changes, lambda: _with_defaults(cls, values))
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


def apply_changes(
    values: Mapping[str, Any], changes: Iterable[str], defaults: Callable[[], Mapping[str, Any]]
) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Return `values` with single entries replaced; whether a key exists is not checked here.

    Args:
        values: Keys and values, as YAML gives them; not modified.
        changes: `dotted.key=value`; the value is YAML, and an entry of a list is named by its
            index from zero.
        defaults: Gives all keys with their defaults; asked when a change leads into a mapping or
            list that `values` leaves out.

    Raises:
        ConfigError: A change is not of this form, or leads into a value that has no entries.
    """
    for change in changes:
        key, equals, text = change.partition("=")
        names = key.split(".")
        if not equals or not all(names):
            raise ConfigError(
                f"'{one_line(change)}': expected KEY=VALUE with a dotted key, "
                "such as solver.max_iterations=30."
            )
        value = parse_yaml(text, f"'{one_line(change)}'")
        values = _replaced(values, names, 0, value, defaults)
    return values


def _replaced(
    here: Any,  # noqa: ANN401 - any YAML value
    names: list[str],
    depth: int,
    value: object,
    defaults: Callable[[], Mapping[str, Any]],
) -> Any:  # noqa: ANN401
    """Return the value below `names[:depth]` with the entry at `names` replaced."""
    if depth == len(names):
        return value
    above, name = ".".join(names[:depth]), names[depth]
    if here is None:
        here = _default(defaults(), names[:depth])
    if isinstance(here, Mapping):
        return {**here, name: _replaced(here.get(name), names, depth + 1, value, defaults)}
    if not isinstance(here, list | tuple):
        raise ConfigError(
            one_line(f"'{'.'.join(names)}': '{above}' is the value {here!r}, ")
            + "which has no entries."
        )
    if not name.isdecimal() or int(name) >= len(here):
        span = f"0 to {len(here) - 1}" if here else "none: it is empty"
        raise ConfigError(
            f"'{one_line(f'{above}.{name}')}': '{above}' is a list; its entries are {span}."
        )
    changed = _replaced(here[int(name)], names, depth + 1, value, defaults)
    return [changed if index == int(name) else one for index, one in enumerate(here)]


def _default(here: Any, names: list[str]) -> Any:  # noqa: ANN401 - any YAML value
    """Return the default at `names`, or an empty mapping where there is none."""
    for name in names:
        if isinstance(here, list):
            here = {str(index): entry for index, entry in enumerate(here)}
        here = here.get(name) if isinstance(here, Mapping) else None
    return {} if here is None else here


def configs_folder() -> Path:
    """Return the folder of the shipped configurations.

    An installed package holds it as `tofcorr/configs`; in a checkout it stands beside `tofcorr`.
    """
    package = Path(__file__).resolve().parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def shipped_folders() -> list[str]:
    """Return the folders of shipped configurations: `train`, `evaluate`, ..."""
    return sorted(path.name for path in configs_folder().glob("*") if path.is_dir())


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
    if not folder or _exists(path):
        return path
    names = shipped_names(folder)
    close = get_close_matches(path.stem, names, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    raise ConfigError(
        f"{text}: neither a file nor a configuration shipped for '{folder}'.{hint} "
        f"Shipped: {', '.join(names)}."
    )


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # A name too long for any file.
        return False
