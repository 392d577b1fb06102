"""The files under test, and the settings that they mention."""

import json
import os
import re
import subprocess
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
SCRATCH = Path(os.environ["SCRATCH"])
BINARY = os.environ["BINARY"]
DEFAULTS = tomllib.loads((DEPLOY / "whereabouts.toml").read_text())
VERSION = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
METRIC = re.compile(r"whereabouts_[a-z0-9_]+")
SETTING = re.compile(rf"(?<![\w/.-])({'|'.join(DEFAULTS)})\.([a-z][a-z0-9_]+)(?![\w.]*[/(])")
VARIABLE = re.compile(r"\bWHEREABOUTS_([A-Z0-9]+)__([A-Z0-9_]+)")


def read(name):
    return (ROOT / name).read_text()


def documents(name):
    """All documents of a YAML file."""
    return [one for one in yaml.safe_load_all(read(name)) if one is not None]


def dashboard():
    return json.loads(read("deploy/grafana/whereabouts.json"))


def drain_times():
    """The maximum shutdown time: requests, work on frames and refinement drain one after another."""
    return 3 * DEFAULTS["server"]["drain_timeout_s"]


def unknown_settings(text):
    """Settings and environment variables that a text mentions and that do not exist."""
    named = [(section, key, f"{section}.{key}") for section, key in SETTING.findall(text)]
    named += [
        (section.lower(), key.lower(), f"WHEREABOUTS_{section}__{key}")
        for section, key in VARIABLE.findall(text)
        if section != "SECTION"
    ]
    files = {"toml", "rs", "pem", "key", "json", "yaml"}
    return sorted(
        {name for section, key, name in named if key not in DEFAULTS.get(section, {}) and key not in files}
    )


def check_settings(case, *names):
    """Fails if one of these files mentions a setting that does not exist."""
    for name in names:
        unknown = ", ".join(unknown_settings(read(name)))
        case.assertFalse(unknown, f"{name} mentions settings that do not exist: {unknown}")


def settings_in_force(environment):
    """The output of `whereabouts config` with only these variables set."""
    ours = {key: value for key, value in environment.items() if key.startswith("WHEREABOUTS_")}
    ran = subprocess.run([BINARY, "config"], env=ours, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise AssertionError(f"whereabouts config: {ran.stderr.strip()}")
    return tomllib.loads(ran.stdout)


def seconds(text):
    """Parses 75, 75s or 1m15s."""
    parts = re.findall(r"(\d+)(ms|s|m|h|)", str(text))
    return sum(int(number) * {"ms": 0.001, "s": 1, "": 1, "m": 60, "h": 3600}[unit] for number, unit in parts)


def report(*words):
    """Prints what was checked."""
    print("  ", *words, flush=True)
