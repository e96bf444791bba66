"""Every mistake in one clear line."""

from __future__ import annotations

import difflib
import re
from contextlib import suppress
from dataclasses import fields

import hydra
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from saferl.config import catalog, schema
from saferl.config.flat import flat
from saferl.config.locate import config_dir

#: What a user can get wrong; any other exception is a fault of ours and keeps its trace.
MISTAKES = (ValueError, OSError, HydraException, OmegaConfBaseException)


def explain(error: Exception, config: str = "config", arguments: list[str] | None = None) -> str:
    """A mistake in one line: which key, what was given, what is expected."""
    if isinstance(error, MissingConfigException) and error.options:
        group, _, choice = str(error.missing_cfg_file).rpartition("/")
        options = [option for option in error.options if not option.endswith("_schema")]
        return f"{group} must be one of {', '.join(options)}, got {choice!r}."
    if isinstance(error, InstantiationException):
        place = str(error).rpartition("full_key: ")[2]
        cause = error.__cause__ or str(error).splitlines()[0]
        return f"{cause} (in {place})" if place != str(error) else str(cause)
    reason: BaseException | None = error
    while reason is not None:
        if (line := _of_another_kind(str(reason), str(error))) is not None:
            return line
        reason = reason.__cause__
    message = " ".join(str(error).split())
    if message.startswith("Could not override"):
        return _unknown_key(message.split("'")[1], config, arguments or [])
    if found := re.match(r"Error merging override ([\w.]+)=(\S+)$", message):
        node = OmegaConf.select(_composed(config, arguments or [], found[1]), found[1])
        known = ", ".join(map(str, node)) if isinstance(node, DictConfig) else "settings"
        return f"{found[1]} must be a mapping of {known}, got {found[2]}."
    if found := re.match(r"Config group override must be a string or a list", message):
        for key, _, value in (argument.partition("=") for argument in arguments or []):
            choices = catalog.options(key) if key in catalog.GROUPS else {value: ""}
            if value not in choices:
                return f"{key} must be one of {', '.join(choices)}, got {value}."
        return "a group takes the name of a choice; --help lists the groups and their choices."
    if found := re.search(r"^In '(.*?)': .*?Key '(.*?)' not in .*? full_key: (\S+)", message):
        return f"unknown key {found[3]} in {found[1]}; {_hint(found[2], _beside(found[3], config))}"
    # Of a run's own file, which somebody has edited.
    if found := re.match(r"Key '(.*?)' not in '.*?' full_key: (\S+)", message):
        return f"unknown key {found[2]}; {_hint(found[1], _beside(found[2], config))}"
    if found := re.search(r"interpolation: Missing mandatory value: (\S+)", message):
        return f"{found[1]} is missing."
    if found := re.match(r"Missing (?:mandatory value:|key) .*? full_key: (\S+)", message):
        return f"{found[1]} is missing."
    if isinstance(error, HydraException):
        return message.partition(" See https")[0]
    return message


#: OmegaConf's words for the kinds of settings, and ours.
KINDS = {"Integer": "a whole number", "Float": "a number", "int": "a whole number"}
KINDS |= {"float": "a number", "bool": "true or false", "str": "text", "String": "text"}


def _of_another_kind(message: str, override: str) -> str | None:
    """What OmegaConf says of a value of another kind than its setting, in one line."""
    where = re.search(r"full_key: (\S+)", message)
    if where is None:
        return None
    if found := re.search(
        r"Value '(.*?)' of type '(\w+)' could not be converted to (\w+)", message
    ):
        value = repr(found[1]) if found[2] == "str" else found[1]
        return f"{where[1]} must be {KINDS[found[3]]}, got {value}."
    if found := re.search(r"Value '(.*?)' is not a valid bool", message):
        return f"{where[1]} must be true or false, got {found[1]!r}."
    if re.search(r"is not Optional|Incompatible value 'None'", message):
        return f"{where[1]} must not be null."
    if found := re.search(r"Invalid value assigned: (\w+) is not a (\w+)", message):
        given = re.search(r"override \S+?=(\S+)", override)
        return f"{where[1]} must be a list, got {given[1] if given else found[1]}."
    return None


def _beside(key: str, config: str) -> list[str]:
    """The settings beside one of the root's, as far as they are known without composing."""
    kinds = {"config": schema.Training, "evaluate": schema.Test, "export": schema.Export}
    names = [field.name for field in fields(kinds[config])]
    return names if "." not in key else []


def _hint(name: str, choices: list[str]) -> str:
    """The nearest choice, and all of them."""
    close = difflib.get_close_matches(name, choices, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}Choose from {', '.join(choices)}." if choices else "see --help."


def _composed(config: str, arguments: list[str], mistaken: str) -> DictConfig:
    """The configuration of a command line, but for its mistakes, of which ``mistaken`` is one."""
    given = [a for a in arguments if "=" in a and not a.startswith("-")]
    given = [a for a in given if a.lstrip("+~").partition("=")[0] != mistaken]
    # Choices first, as settings follow from them.
    given.sort(key=lambda argument: "." in argument.partition("=")[0])
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"), suppress(HydraException):
        return hydra.compose(config, given)
    composed, rest = OmegaConf.create(), []
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        for argument in ["", *given]:
            with suppress(HydraException):  # of several mistakes this one is told
                composed = hydra.compose(config, [*rest, *filter(None, [argument])])
                rest += filter(None, [argument])
    return composed


def _unknown_key(key: str, config: str, arguments: list[str]) -> str:
    """Tells what stands beside a key that does not exist."""
    composed = _composed(config, arguments, key)
    parent, _, name = key.rpartition(".")
    node = OmegaConf.select(composed, parent) if parent else composed
    while parent and not isinstance(node, DictConfig):
        parent, _, name = parent.rpartition(".")
        node = OmegaConf.select(composed, parent) if parent else composed
    choices = [str(k) for k in node if k != "_target_"]
    if node.get("_target_", "") is None:
        return f"unknown key {key!r}; {parent.partition('.')[0]}=none has no settings."
    if "_target_" in node and OmegaConf.get_type(node) is dict:
        from saferl.config import check  # late, as it imports the target

        accepted = check.arguments(node._target_)
        if accepted == {}:
            return f"unknown key {key!r}; {node._target_} takes nothing."
        choices = list(accepted or choices)
    if not choices:  # an empty mapping: what it may hold, its class says
        return f"unknown key {key!r}; {parent} is empty by default, set it with +{key}=..."
    if name in choices:
        return f"{key!r} stands at the default of its class; set it with +{key}=..."
    settings = OmegaConf.to_container(composed, resolve=False)
    deeper = [] if parent else [k for k in flat(settings) if k.rpartition(".")[2] == name]
    close = (
        deeper if len(deeper) == 1 else difflib.get_close_matches(name, choices, n=1, cutoff=0.7)
    )
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown key {key!r}{hint}; choose from {', '.join(choices)}."
