"""Grid worlds as text, in colour where the terminal has it."""

from __future__ import annotations

import os
import sys

from envs.grid_dynamics import MOVE_NAMES
from envs.grid_map import START
from envs.scene import Scene

ROBOT = "R"
TRAIL = "*"
# What a terminal of common size shows; of larger maps the part around the robot is drawn.
MAX_ROWS = 40
MAX_COLUMNS = 100
RESET = "\x1b[0m"
# Select Graphic Rendition of ECMA-48: 1 bold, 2 faint, 3x colours, 44 on blue.
STYLES = {
    ROBOT: "\x1b[1;37;44m",
    TRAIL: "\x1b[34m",
    "#": "\x1b[2m",
    "S": "\x1b[36m",
    "G": "\x1b[1;32m",
    "M": "\x1b[1;31m",
    "P": "\x1b[1;33m",
}


def render_text(scene: Scene) -> str:
    """The latest action on a line, then the map: ``R`` the robot, ``*`` where it has been."""
    robot_row, robot_column = scene.place(scene.robot)
    rows = _window(robot_row, len(scene.rows), MAX_ROWS)
    columns = _window(robot_column, len(scene.rows[0]), MAX_COLUMNS)
    trail = {scene.place(cell) for step in scene.steps for cell in step}
    marks = {(row, column): TRAIL for row, column in trail if scene.rows[row][column] != START}
    marks[robot_row, robot_column] = ROBOT
    style = _coloured if terminal_has_colour() else str
    lines = [_title(scene, rows, columns)]
    for row in rows:
        letters = (marks.get((row, column), scene.rows[row][column]) for column in columns)
        lines.append("".join(map(style, letters)))
    return "\n".join(lines) + "\n"


def terminal_has_colour() -> bool:
    """Whether standard output is a terminal that shows colours and the user has not opted out."""
    opted_out = bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
    return sys.stdout.isatty() and not opted_out


def _title(scene: Scene, rows: range, columns: range) -> str:
    move = "start" if scene.last_action is None else MOVE_NAMES[scene.last_action]
    title = f"({move if scene.title is None else scene.title})"
    if len(rows) < len(scene.rows) or len(columns) < len(scene.rows[0]):
        title += f" rows {rows[0]}-{rows[-1]}, columns {columns[0]}-{columns[-1]}"
    return title


def _window(centre: int, length: int, most: int) -> range:
    """At most so many indices around one of them."""
    first = max(0, min(centre - most // 2, length - most))
    return range(first, min(first + most, length))


def _coloured(letter: str) -> str:
    return f"{STYLES[letter]}{letter}{RESET}" if letter in STYLES else letter
