"""The terminal. What users named and described is printed as it is: never markup, an emoji or an order to the terminal."""

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from uavmec_jax.errors import printable
from uavmec_jax.reporting.fitting import fitted


class PlainConsole(Console):
    """A console on which text, in tables too, has no meaning but itself."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Make a renderable of text; characters that a terminal would obey, or cannot show, are escaped."""
        return super().render_str(printable(text, keep="\n"), **options)

    def print_table(self, table: Table) -> None:
        """Print a table so that it fits: names wrap first, then columns go below; no number is cut."""
        for part in fitted(table, self):
            self.print(part)

    def print_heading(self, name: str, text: str, *, soft_wrap: bool = False) -> None:
        """Print a line that begins with a name in bold type."""
        line = Text.assemble((printable(name), "bold"), f": {printable(text)}")
        self.print(line, soft_wrap=soft_wrap)


def new_console(*, stderr: bool = False) -> PlainConsole:
    """Make the console of a command, on standard output or on standard error."""
    return PlainConsole(stderr=stderr, markup=False, emoji=False)
