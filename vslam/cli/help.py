"""The ``--help`` of a command, with a panel for each group of options."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.highlighter import RegexHighlighter
from rich.padding import Padding
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from rich.theme import Theme

_THEME = Theme({"option": "bold cyan"})


class _Options(RegexHighlighter):
    highlights = [r"(?P<option>(?<![\w-])--[a-z][a-z-]*)"]  # noqa: RUF012  # as rich declares it


def show_help(command: Any, context: Any) -> None:
    """Print the help of a command or of a group of commands on stdout.

    Args:
        command: a ``TyperCommand`` or ``TyperGroup``. The ``rich_help_panel`` of a parameter is the
            name of its panel.
        context: the click context of the command.
    """
    console = Console(theme=_THEME, highlighter=_Options())
    console.print(Padding(Text(command.get_usage(context), "bold"), (1, 1)))
    for paragraph in command.help.split("\n\n"):
        console.print(Padding(Text.from_markup(" ".join(paragraph.split())), (0, 1, 1, 1)))
    panels: dict[str, list[tuple[str, Text]]] = {}
    for parameter in command.get_params(context):
        if not parameter.hidden and parameter.name != "help":
            is_option = parameter.param_type_name == "option"
            title = parameter.rich_help_panel or ("Options" if is_option else "Arguments")
            panels.setdefault(title, []).append(
                (_name_in_help(parameter), _description_with_default(parameter))
            )
    for name, one in getattr(command, "commands", {}).items():
        if not one.hidden:
            summary = " ".join(one.help.split("\n\n")[0].split())
            panels.setdefault("Commands", []).append((name, Text.from_markup(summary)))
    width = max((len(name) for rows in panels.values() for name, _ in rows), default=0)
    for title, rows in panels.items():
        table = Table.grid(padding=(0, 2))
        table.add_column(width=width, style="bold cyan", no_wrap=True)
        table.add_column(overflow="fold")
        for name, about in rows:
            table.add_row(Text(name), about)
        console.print(Panel(table, title=title, title_align="left", border_style="dim"))
    if command.epilog:
        console.print(Padding(Text.from_markup(command.epilog.strip()), (1, 1)))


def describe_parameters(command: Any, context: Any) -> str:
    """Return sentences that describe the arguments of a command and list its options."""
    arguments, options = [], []
    for parameter in command.get_params(context):
        if parameter.param_type_name == "option":
            options.append("/".join((*parameter.opts, *parameter.secondary_opts)))
        else:
            about = Text.from_markup(parameter.help or "").plain
            arguments.append(f"{context.command_path} takes {_name_in_help(parameter)}: {about}")
    return " ".join([*arguments, f"Its options are {', '.join(options)}."])


def _name_in_help(parameter: Any) -> str:
    """Return the name of a parameter in the help, such as ``--map FILE`` or ``RUN``."""
    if parameter.param_type_name == "argument":
        name = parameter.metavar or parameter.name.upper()
        return f"{name}..." if parameter.nargs != 1 else str(name)
    names = "/".join((*parameter.opts, *parameter.secondary_opts))
    return f"{names} {parameter.metavar}" if parameter.metavar else names


def _description_with_default(parameter: Any) -> Text:
    text = Text.from_markup(parameter.help or "")
    default = parameter.default
    if isinstance(parameter.show_default, str):
        default = parameter.show_default
    elif not parameter.show_default or isinstance(default, bool):
        default = None  # the names of a flag already show its effect
    if parameter.required:
        text.append(" [required]", "red")
    elif default not in (None, "", ()):
        text.append(f" [default: {default}]", "dim")
    return text
