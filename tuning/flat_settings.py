"""Settings under dotted names, as a search chooses them, and nested, as files hold them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.settings.values import DottedName, parse_literal
from tuning.dimensions import LEFT_OUT


def flat_items(mapping: Mapping[str, Any], names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """The values under dotted names; what is not there is `LEFT_OUT`."""
    for name in names:
        outer, _, inner = name.partition(".")
        value = mapping.get(outer, LEFT_OUT)
        if inner:
            value = value.get(inner, LEFT_OUT) if isinstance(value, Mapping) else LEFT_OUT
        yield name, value


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Flat settings as a file holds them."""
    found: dict[str, Any] = {}
    for key, value in flat.items():
        outer, _, inner = key.partition(".")
        if value is LEFT_OUT:
            continue
        if inner:
            found.setdefault(outer, {})[inner] = value
        else:
            found[outer] = value
    return found


def with_mappings(settings: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """The settings, with mappings that are written as texts read where keys lead into them."""
    outer = {key.partition(".")[0] for key in keys if "." in key}
    return {
        key: _plain(parse_literal(value, key)) if key in outer and isinstance(value, str) else value
        for key, value in settings.items()
    }


def _plain(value: Any) -> Any:
    """Names of classes as the texts that a file holds."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.name if isinstance(value, DottedName) else value
