"""Merges presets, files, environment and command line into one checked `Config`; writes TOML.

Later sources win: defaults < preset < file < environment < command line. Whatever cannot work is
refused here, before anything starts, with one `ConfigError` line that names the key, what was
expected, what came and where it came from. The folder of a run belongs to one configuration.
"""

import json
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from shared.config import Config, Section
from shared.errors import ConfigError, StateError, meant, not_among
from shared.place import is_up
from shared.statefile import create, write_atomically

ENV_PREFIX = "CORRIDOR_"
FILE_NAME = "config.toml"
EVERY_START = {FILE_NAME, "run.json", "numerics", "lock", "endpoint", "logs", "roles", "halts"}
SHORT = {"credentials": "bus.credentials"}
"""Variables of the environment without a section: CORRIDOR_CREDENTIALS."""
Tree = dict[str, Any]


def load(
    preset: str | None = None,
    file: Path | None = None,
    overrides: Sequence[str] = (),
    env: Mapping[str, str] | None = None,
) -> Config:
    """The configuration all sources together give.

    Args:
        preset: name of one in `shared/presets`, or the path of a TOML file.
        file: path of a TOML file; wins over the preset.
        overrides: `section.key=value` texts from the command line, later ones win.
        env: the environment; `CORRIDOR_<SECTION>__<KEY>` is read from it.

    Raises ConfigError on the first problem of any source.
    """
    merged = _Merged()
    if preset is not None:
        merged.add_tree(*_read_preset(preset))
    if file is not None:
        merged.add_tree(_read_toml(file, "configuration file"), f"configuration file {file}")
    for name, text in sorted((env or {}).items()):
        # Compose files pass unset variables on as empty ones.
        if name.startswith(ENV_PREFIX) and text:
            key = name.removeprefix(ENV_PREFIX).lower().replace("__", ".")
            key = SHORT.get(key, key)
            merged.add_text(key, text, f"environment variable {name}")
    for item in overrides:
        key, equals, text = item.partition("=")
        if not equals:
            raise ConfigError(f"--set: expected section.key=value, got {item!r}")
        merged.add_text(key.strip(), text.strip(), "command line")
    return merged.validate()


def from_toml(text: str, source: str) -> Config:
    """The configuration in a text, such as one by `to_toml`; raises ConfigError naming `source`."""
    merged = _Merged()
    merged.add_tree(_parse(text.encode(), source), source)
    return merged.validate()


def preset_names() -> list[str]:
    """Names of the presets that come with the package."""
    folder = resources.files("shared").joinpath("presets")
    names = (entry.name for entry in folder.iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def preset_tree(preset: str) -> Tree:
    """The tables of a preset: what it changes. Raises ConfigError for one that is not there."""
    return _read_preset(preset)[0]


def keys(section: type[Section] = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """All settings as dotted keys with their field, in the order of the tree."""
    for name, field in section.model_fields.items():
        if _is_section(field):
            yield from keys(field.annotation, f"{prefix}{name}.")  # type: ignore[arg-type]
        else:
            yield prefix + name, field


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one table of dotted keys."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[prefix + name] = value
    return flat


def differences(old: Config, new: Config) -> list[tuple[str, Any, Any]]:
    """All keys in which two configurations differ: key, old value, new value."""
    return _differences(old.to_dict(), new.to_dict())


def _differences(old: Tree, new: Tree) -> list[tuple[str, Any, Any]]:
    after = flatten(new)
    return [(k, v, after[k]) for k, v in flatten(old).items() if v != after[k]]


def toml_value(value: bool | int | float | str) -> str:
    """One value as TOML."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value).lower()


def to_toml(config: Config) -> str:
    """The whole tree as TOML; reading it back gives an equal tree."""
    return _toml(config.to_dict())


def _put(tree: Tree, key: str, value: Any) -> None:
    """Set a dotted key of nested tables."""
    *path, name = key.split(".")
    for chunk in path:
        tree = tree.setdefault(chunk, {})
    tree[name] = value


def preset_text(config: Config) -> str:
    """What differs from the defaults as TOML, as a preset has it."""
    tree: Tree = {}
    for key, _, value in differences(Config(), config):
        _put(tree, key, value)
    return _toml(tree)


def _toml(config: Tree) -> str:
    lines: list[str] = []

    def add(tree: Tree, path: str) -> None:
        tables = {name: value for name, value in tree.items() if isinstance(value, dict)}
        if path and len(tables) < len(tree):
            lines.extend(["", f"[{path}]"])
        lines.extend(f"{k} = {toml_value(v)}" for k, v in tree.items() if k not in tables)
        for name, table in tables.items():
            add(table, f"{path}.{name}" if path else name)

    add(config, "")
    return "\n".join(lines).lstrip("\n") + "\n"


def write(config: Config, path: Path) -> None:
    """Write the resolved tree as TOML, whole or not at all."""
    write_atomically(path, _resolved(config))


def claim(folder: Path, config: Config) -> Config:
    """Take the run folder for this configuration; returns the one stored in it.

    The first use creates the folder and its `config.toml`, which then never changes. Only what
    `Config.fingerprint` leaves out (where the router is, how long the run goes on, which robot
    drives and how it is reached) may differ on later uses. As long as nothing ran, all may.

    Raises:
        ConfigError: the folder belongs to another configuration, or cannot be made.
        StateError: its `config.toml` cannot be read.
    """
    path = folder / FILE_NAME
    try:
        str(folder.absolute()).encode()
    except UnicodeEncodeError:
        raise ConfigError(f"run folder {str(folder)!a}: expected a name in UTF-8") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            create(path, _resolved(config))
    except OSError as error:
        raise ConfigError(
            f"run folder {folder}: cannot be created: {error.strerror or error}"
        ) from error
    stored = read_folder(folder)
    if stored.fingerprint() != config.fingerprint() and _unused(folder):
        shutil.rmtree(folder / "numerics", ignore_errors=True)
        (folder / "run.json").unlink(missing_ok=True)
        write(config, path)
        return config
    if stored.fingerprint() != config.fingerprint():
        name, old, new = _differences(stored.binding(), config.binding())[0]
        raise ConfigError(
            f"run folder {folder} belongs to another configuration: {name} is {toml_value(old)} "
            f"there, but {toml_value(new)} now; use another run name (--run) or folder (--run-dir)"
        )
    return stored


def _unused(folder: Path) -> bool:
    """Whether nothing of a run lies in its folder but what every start writes, if it is not up."""

    def empty(path: Path) -> bool:
        if path.suffix == ".csv":
            return path.read_bytes().count(b"\n") < 2
        known = path.relative_to(folder).parts[0] in EVERY_START
        return known or (path.suffix == ".mdb" and path.stat().st_size <= 8192)

    return not is_up(folder) and all(empty(path) for path in folder.rglob("*") if path.is_file())


def read_folder(folder: Path) -> Config:
    """The configuration stored in a run folder. Raises StateError if there is none or it is bad."""
    path = folder / FILE_NAME
    try:
        return load(file=path)
    except ConfigError as error:
        raise StateError(f"run folder {folder} is damaged: {error}") from error


def _resolved(config: Config) -> bytes:
    header = "# Resolved configuration of this run, written when the run began.\n\n"
    return (header + to_toml(config)).encode()


class _Merged:
    """Values of all sources so far, and where each came from."""

    def __init__(self) -> None:
        self.values: Tree = {}
        self.sources: dict[str, str] = {}
        self.fields = dict(keys())

    def add_tree(self, tree: Tree, source: str) -> None:
        """Merge the tables of a TOML file."""
        for key, value in flatten(tree).items():
            self._set(key, value, source)

    def add_text(self, key: str, text: str, source: str) -> None:
        """Merge one value given as text: TOML if it is valid TOML, else the text itself."""
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        field = self.fields.get(key)
        if field is not None and field.annotation is str and not isinstance(value, str):
            value = text  # a run may be called 2024
        self._set(key, value, source)

    def _set(self, key: str, value: Any, source: str) -> None:
        if key not in self.fields:
            raise ConfigError(f"{self._unknown(key)} ({source})")
        _put(self.values, key, value)
        self.sources[key] = source

    def _unknown(self, key: str) -> str:
        inside = [name for name in self.fields if name.startswith(key + ".")]
        if inside:
            return f"{key}: expected a key inside this section, such as {inside[0]}"
        same_end = [name for name in self.fields if name.rsplit(".", 1)[-1] == key]
        hint = f", did you mean {same_end[0]}?" if same_end else meant(key, self.fields)
        return f"{key}: unknown key{hint or ', see `corridor config`'}"

    def validate(self) -> Config:
        """The checked tree. Raises ConfigError for the first problem."""
        try:
            return Config.model_validate(self.values)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
        key = ".".join(str(chunk) for chunk in problem["loc"])
        if problem["type"] == "value_error":  # a combination: its text names the keys
            text = problem["msg"].removeprefix("Value error, ")
            raise ConfigError(f"{text} ({self._sources_of(text)})")
        expected = problem["msg"].removeprefix("Input should be ")
        expected = re.sub(r"^String should ", "a text to ", expected)
        source = self.sources.get(key, "default")
        hint = meant(str(problem["input"]), re.findall(r"'([^']+)'", expected))
        raise ConfigError(
            f"{key}: expected {expected}, got {problem['input']!r:.100}{hint} ({source})"
        )

    def _sources_of(self, text: str) -> str:
        """Where the keys named in a text came from, without repetition."""
        named = [key for key in self.fields if re.search(rf"(?<![\w.]){re.escape(key)}\b", text)]
        return "; ".join(f"{key}: {self.sources.get(key, 'default')}" for key in named)


def _is_section(field: FieldInfo) -> bool:
    return isinstance(field.annotation, type) and issubclass(field.annotation, Section)


def _read_preset(preset: str) -> tuple[Tree, str]:
    """The tables of a preset and how to name it as a source."""
    if preset.endswith(".toml") or "/" in preset:
        return _read_toml(Path(preset), "preset file"), f"preset file {preset}"
    if preset not in preset_names():
        raise not_among("--preset", preset, preset_names(), " or a .toml file")
    text = resources.files("shared").joinpath("presets", f"{preset}.toml").read_bytes()
    return _parse(text, f"preset {preset}"), f"preset {preset}"


def _read_toml(path: Path, what: str) -> Tree:
    try:
        return _parse(path.read_bytes(), f"{what} {path}")
    except OSError as error:
        raise ConfigError(f"{what} {path}: cannot be read: {error.strerror}") from error


def _parse(data: bytes, source: str) -> Tree:
    try:
        return tomllib.loads(data.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{source}: expected TOML: {error}") from error
