"""The configurations that come with the package, by name."""

from difflib import get_close_matches
from pathlib import Path

from tofcorr.errors import ConfigError


def configs_folder() -> Path:
    """Return the folder of the shipped configurations.

    An installed package holds it as `tofcorr/configs`; in a checkout it stands beside `tofcorr`.
    """
    package = Path(__file__).resolve().parents[1]
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
