"""Parses /metrics: families with their types, and the labels of each sample."""

import re
from dataclasses import dataclass, field

FAMILY = re.compile(r"# (HELP|TYPE) (\S+) (.*)")
SAMPLE = re.compile(r"([a-zA-Z_:][\w:]*)(?:\{(.*)\})? (\S+)$")
LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"')
SUFFIXES = {"counter": ["_total"], "histogram": ["_bucket", "_sum", "_count"], "gauge": [""]}


@dataclass
class Metric:
    """A metric name that a query can use."""

    type: str
    help: str
    # The values seen for each label.
    labels: dict[str, set[str]] = field(default_factory=dict)


def parse(text):
    """Parses a response into metrics by sample name."""
    if not text.endswith("# EOF\n"):
        raise ValueError("the response has no # EOF")
    about, metrics = {}, {}
    for line in text.splitlines()[:-1]:
        if known := FAMILY.fullmatch(line):
            what, family, words = known.groups()
            about.setdefault(family, {})[what] = words
            if what == "TYPE":
                for suffix in SUFFIXES[words]:
                    metrics[family + suffix] = Metric(words, about[family]["HELP"])
            continue
        sample = SAMPLE.fullmatch(line)
        if not sample or sample[1] not in metrics:
            raise ValueError(f"not a sample of a declared family: {line}")
        for name, value in LABEL.findall(sample[2] or ""):
            metrics[sample[1]].labels.setdefault(name, set()).add(value)
    return metrics
