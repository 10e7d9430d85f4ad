"""Commands of palpate as interfaces of nipype and tasks of pydra: ``pip install palpate nipype``.

Both are made from what ``palpate COMMAND --xml`` says of the command, so they have the options of the
version that is installed.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, List, Optional, Sequence, Type
from xml.etree import ElementTree

#: The commands that describe themselves.
COMMANDS = ("field", "warp", "strain", "stiffness", "track")
#: What runs palpate: the command of this package.
PROGRAM = (sys.executable, "-m", "palpate")


@dataclass(frozen=True)
class Option:
    """An argument of a command."""

    name: str
    #: As on the command line; none for an argument without one.
    flag: Optional[str]
    position: Optional[int]
    #: ``boolean``, ``file``, ``directory`` or ``string``.
    kind: str
    multiple: bool
    is_output: bool
    help: str


def options(command: str, program: Sequence[str] = PROGRAM) -> List[Option]:
    """The arguments of a command, in the order of its help.

    Raises ``ValueError`` for a command that does not describe itself.
    """
    if command not in COMMANDS:
        raise ValueError(f"{command!r} is none of {', '.join(COMMANDS)}")
    text = subprocess.run([*program, command, "--xml"], check=True, capture_output=True, text=True).stdout
    found = []
    for group in ElementTree.fromstring(text).iter("parameters"):
        for element in group:
            name = element.findtext("name")
            # What a module gives back to 3D Slicer, and how it tells of its progress.
            if name is None or element.get("hidden") or name.startswith("return_"):
                continue
            index = element.findtext("index")
            kind = {"image": "file", "file": "file", "directory": "directory", "boolean": "boolean"}
            found.append(
                Option(
                    name=name,
                    flag=element.findtext("longflag"),
                    position=None if index is None else int(index),
                    kind=kind.get(element.tag, "string"),
                    multiple=element.get("multiple") == "true",
                    is_output=element.findtext("channel") == "output",
                    help=element.findtext("description") or "",
                )
            )
    return found


def nipype_interface(command: str, program: Sequence[str] = PROGRAM) -> Type[Any]:
    """A ``CommandLine`` of nipype; its outputs are those of the command, as absolute paths.

    >>> Field = nipype_interface("field")                                     # doctest: +SKIP
    >>> Field(initial="a.nii.gz", deformed="b.nii.gz", output="f").run()      # doctest: +SKIP
    """
    from nipype.interfaces.base import CommandLine, CommandLineInputSpec, TraitedSpec, traits
    from nipype.interfaces.base.traits_extension import Directory, File, InputMultiPath

    given = options(command, program)

    def trait(option: Option) -> Any:
        after = "" if option.kind == "boolean" else " %s"
        meta = {"argstr": f"{option.flag}{after}" if option.flag else "%s", "desc": option.help}
        if option.position is not None:
            meta["position"] = 1 + option.position
        if option.is_output:
            return traits.Str(mandatory=True, **meta)
        if option.kind == "boolean":
            return traits.Bool(**meta)
        one = {"file": File, "directory": Directory}.get(option.kind)
        if one is None:
            return traits.Str(**meta)
        if option.multiple:
            return InputMultiPath(one(exists=True), **meta)
        return one(exists=True, mandatory=option.position is not None, **meta)

    inputs = type(f"{command.capitalize()}InputSpec", (CommandLineInputSpec,), {o.name: trait(o) for o in given})
    made = [o for o in given if o.is_output]
    of_kind = {o.name: (File if o.kind == "file" else Directory)(exists=True) for o in made}
    outputs = type(f"{command.capitalize()}OutputSpec", (TraitedSpec,), of_kind)

    def list_outputs(self: Any) -> Any:
        return {o.name: str(Path(getattr(self.inputs, o.name)).absolute()) for o in made}

    body = {
        "input_spec": inputs,
        "output_spec": outputs,
        "_cmd": " ".join([*program, command]),
        "_list_outputs": list_outputs,
        "__doc__": f"``palpate {command}``",
    }
    return type(command.capitalize(), (CommandLine,), body)


def pydra_task(command: str, program: Sequence[str] = PROGRAM, **inputs: Any) -> Any:
    """A ``ShellCommandTask`` of pydra (0.2x) with these inputs; ``output`` is what it gives back.

    >>> pydra_task("field", initial="a.nii.gz", deformed="b.nii.gz", output="f")()   # doctest: +SKIP
    """
    from pydra.engine.specs import ShellOutSpec, ShellSpec, SpecInfo
    from pydra.engine.task import ShellCommandTask

    given = options(command, program)

    def field(option: Option) -> Any:
        meta = {"argstr": option.flag or "", "help_string": option.help}
        if option.position is not None:
            meta["position"] = 1 + option.position
        if option.is_output or option.position is not None:
            meta["mandatory"] = True
        return (option.name, bool if option.kind == "boolean" else str, meta)

    made = [o for o in given if o.is_output]

    def place(name: str) -> Any:
        def found(inputs: Any) -> Any:
            return str(Path(getattr(inputs, name)).absolute())

        return found

    outputs = [(f"{o.name}_path", str, {"callable": place(o.name), "help_string": o.help}) for o in made]
    return ShellCommandTask(
        name=f"palpate_{command}",
        executable=[*program, command],
        input_spec=SpecInfo(name="Input", fields=[field(o) for o in given], bases=(ShellSpec,)),
        output_spec=SpecInfo(name="Output", fields=outputs, bases=(ShellOutSpec,)),
        **inputs,
    )
