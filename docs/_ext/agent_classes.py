"""Documents the classes of all agents of this project that the registry lists."""

from __future__ import annotations

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class AgentClasses(SphinxDirective):
    """``.. agent-classes::``, the documentation of each class that the registry names."""

    def run(self) -> list[nodes.Node]:
        from rl_yardstick.agents import ALGORITHMS

        places = [entry.entry_point.replace(":", ".") for entry in ALGORITHMS.values()]
        own = [place for place in dict.fromkeys(places) if place.startswith("rl_yardstick.agents.")]
        lines = [line for place in own for line in (f".. autoclass:: {place}", "")]
        node = nodes.container()
        self.state.nested_parse(StringList(lines, source="agents"), self.content_offset, node)
        return node.children


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("agent-classes", AgentClasses)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
