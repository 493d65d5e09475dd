"""The command `raytrace`: parse, call the library once, print or save.

`main(argv)` runs any command in-process and returns its exit code. A command's module, and torch with it, is imported
only when the command runs, so that `raytrace --help` answers at once.

- `commands`: the table of commands, each with its summary, examples and options; `options`: the table of options that
  several commands share; `types`: readers of their values.
- `runner`: opens the lens, calls the function, prints, saves; `progress`: bars.
- `runs`, `render_run`: functions of commands that do more.
- `codesign`, `wave_…`, `settings`: co-design and phase elements, whose options are fields of settings.

To add a command: a public function and a row of `COMMANDS`. To add an option: a parameter of the function and an
`Option` in the row of its command, or in `OPTIONS` if several commands have it. Tests: `test_cli`, `test_cli_options`,
`test_public`, `test_render_command`, `test_wave_cli`, `test_codesign_cli`.
"""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from raytrace.budget import keep_freed_memory
from raytrace.files import NotWritten
from raytrace.words import RaytraceError, did_you_mean, in_command

DESCRIPTION = "A sequential, differentiable ray tracer: read a lens file, trace it, focus it, plot it."

EXAMPLES = """\
start here:
  raytrace info lenses/double_gauss.zmx
  raytrace focus lenses/double_gauss.zmx --object-distance 25000 --plot focus.png
  raytrace glass N-BK7 --wavelength 0.5876

LENS is a lens file (.zmx, .zar, .seq, .len, or a prescription table .csv, .tsv, .txt) or the name of a shipped lens, as
double_gauss.
Lengths are mm, wavelengths µm, angles degrees. `raytrace COMMAND --help` teaches each command by example.

Large batches are traced by C++ that is compiled once for the machine, where there is a compiler; RAYTRACE_TRACE=eager
traces by torch alone, =compiled always by C++, and RAYTRACE_CACHE is the folder that the compiled code is kept in.
"""


class _Parser(argparse.ArgumentParser):
    """argparse, with its usage errors in one line like every other error, that suggests the nearest option."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._negative_number_matcher = re.compile(r"-[\d.][\d.,eE+-]*$")  # -3,4 and -1e-3 are no options

    def error(self, message: str) -> NoReturn:
        if message.endswith("is not a number"):
            message += " (LENS goes before the options)"
        print(f"raytrace: error: {message}; see `{self.prog} --help`", file=sys.stderr)
        raise SystemExit(2)

    def _parse_optional(self, arg_string: str) -> Any:
        """An option may also be spelled as the parameter of its function: --fields for --field."""
        name, sign, value = arg_string.partition("=")
        if name not in self._option_string_actions and name.startswith("--"):
            parameter = name[2:].replace("-", "_")
            actions = (a for a in self._actions if a.option_strings and a.dest == parameter)
            action = next((a for a in actions if a.const is not False), None)  # --distortion is not --no-distortion
            arg_string = arg_string if action is None else action.option_strings[-1] + sign + value
        return super()._parse_optional(arg_string)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        arguments, unknown = super().parse_known_args(args, namespace)
        option = next((word for word in unknown if word.startswith("-")), None)
        if option is not None:
            name = option.partition("=")[0]
            known = self._option_string_actions
            drawn = name in ("-o", "--output") and "--plot" in known
            meant = "; figures are saved by --plot" if drawn else did_you_mean(name, known)
            meant = "; tables are saved by -o FILE.csv" if name == "--csv" and "-o" in known else meant
            self.error(f"unknown option {name}{meant}")
        if unknown:
            places = [action for action in self._actions if not action.option_strings]
            takes = " ".join(f"{'one ' if action.nargs is None else ''}{action.metavar}" for action in places)
            more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
            self.error(f"unexpected {unknown[0]}{more}: the command takes {takes or 'options alone'}")
        return arguments, unknown

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            listed = ", ".join(map(str, action.choices))
            meant = did_you_mean(str(value), map(str, action.choices))
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{meant} (choose from {listed})")


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """The parser of the whole command line, or with the options of `only` one command; imports no torch."""
    from raytrace.cli.commands import COMMANDS

    parser = _Parser(
        prog="raytrace", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"raytrace {version()}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_to(commands, with_options=only in (None, command.name))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; returns 0; 1 for bad input or a missed goal, 2 for bad usage, 130 if interrupted.

    Results go to stdout; progress, warnings and errors to stderr, one line each.
    """
    try:
        words = sys.argv[1:] if argv is None else argv
        arguments = build_parser(next((word for word in words if not word.startswith("-")), "")).parse_args(words)
    except SystemExit as stop:  # argparse printed its help or its usage error
        return stop.code if isinstance(stop.code, int) else 2
    return execute(arguments)


def execute(arguments: argparse.Namespace, report: Callable[..., object] | None = None) -> int:
    """Carry out a parsed command line, as `main` does. report: of its progress (`progress.heartbeat`)."""
    with warnings.catch_warnings(), in_command(arguments.flags):
        warnings.simplefilter("always")
        shown: set[type[Warning]] = set()
        of_result: list[str] = []
        warnings.showwarning = _shower(shown, of_result)
        try:
            from raytrace.budget import within
            from raytrace.cli.commands import function
            from raytrace.cli.progress import heartbeat

            with heartbeat(arguments.command, report), within(getattr(arguments, "max_bytes", None)):
                code = function(arguments.run.carried_out_by)(arguments)
            for words in of_result:
                print(words, file=sys.stderr)
            return 1 if any(issubclass(category, NotWritten) for category in shown) else code
        except KeyboardInterrupt:
            return _fail("interrupted", 130)
        except BrokenPipeError:
            # The reader of our output left, as `| head` does; keep Python from complaining once more at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except Exception as error:
            if os.environ.get("RAYTRACE_TRACEBACK"):
                raise
            expected = isinstance(error, (RaytraceError, ValueError, LookupError, OSError))
            if expected and not isinstance(error, KeyError | IndexError):
                return _fail(_one_line(error), 1)
            if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
                return _fail(f"not enough memory{_largest(arguments)}; --max-bytes refuses sooner", 1)
            kind = type(error).__name__
            return _fail(
                f"{kind}: {_one_line(error)} (a defect of raytrace; RAYTRACE_TRACEBACK=1 shows where, please report)", 1
            )


def script() -> None:
    """The console script: `main` on the arguments of the process."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without µ shows ?
    if sys.stdout is None:  # Python drops what is printed there
        sys.exit(_fail("output: standard output is closed; send it to a file, or to /dev/null", 1))
    keep_freed_memory()
    sys.exit(main())


def _largest(arguments: argparse.Namespace) -> str:
    """The option with the largest number, of which less may help, as the end of a message."""
    values = vars(arguments)
    numbers = [(values[name], flag) for name, flag in arguments.flags.items() if type(values.get(name)) is int]
    number, flag = max(numbers, default=(0, ""))
    return f"; ask for less by {flag}, which is {number}" if flag else ""


def _fail(message: str, code: int) -> int:
    print(f"raytrace: error: {message}", file=sys.stderr)
    return code


def _one_line(error: BaseException | str) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, OSError) and error.strerror:
        return f"output: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _shower(shown: set[type[Warning]], of_result: list[str]) -> Callable[..., None]:
    """Shows warnings of this package, one line each and none twice, and adds their categories to `shown`; those of
    libraries speak to programmers. of_result: collects those that qualify a result (`of_result` of their category),
    which are not shown where there is none.
    """
    lines = set()

    def show(message: Warning | str, category: type[Warning], *place: object) -> None:
        line = f"raytrace: warning: {_one_line(message)}"
        if category.__module__.startswith("raytrace") and line not in lines:
            lines.add(line)
            shown.add(category)
            if getattr(category, "of_result", False):
                of_result.append(line)
            else:
                print(line, file=sys.stderr)

    return show


def version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("raytrace")
    except PackageNotFoundError:
        return "(not installed)"
