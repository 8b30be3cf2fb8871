"""The command `rgbmidic`: thin; each sub-command calls one function of the library, imported when it is called."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from rgbmidic._version import __version__
from rgbmidic.cli import before, command, fields, measure, results, stereo

_GROUPS = {
    "Before a test": before,
    "A test": measure,
    "Two cameras": stereo,
    "Its result": results,
    "Fields of the result": fields,
}
"""Headings of the help, with the commands below each."""


class _Grouped(TyperGroup):
    """Commands that the help lists under their headings."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands heading by heading."""
        limit = formatter.width - 6 - max(map(len, self.commands))
        for heading, module in _GROUPS.items():
            names = [
                typer.main.get_command_name(registered.callback.__name__)
                for registered in module.app.registered_commands
            ]
            with formatter.section(heading):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(limit)) for name in names])


app = command.application("rgbmidic", _Grouped)


def main() -> None:
    """Run the command."""
    command.main(app)


@app.callback(invoke_without_command=True)
def _rgbmidic(
    context: typer.Context,
    version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False,
    debug: Annotated[bool, Option("--debug", help="Show where an error occurs.")] = False,
) -> None:
    """Digital Image Correlation that survives light reflections."""
    if version:
        print(f"rgbmidic {__version__}")
    else:
        command.print_help_without_command(context)


for module in _GROUPS.values():
    app.add_typer(module.app)

if __name__ == "__main__":
    main()
