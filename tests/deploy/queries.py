"""Checks a query against the existing metrics: each name, label and value, and whether functions and
operators get suitable operands."""

import re

import promql_parser as promql

# Labels that the scrape adds to each sample, and metrics that Prometheus itself generates.
OF_TARGET = {"job", "instance", "deployment", "role"}
OF_PROMETHEUS = {"up"}
# Range functions for counters and for gauges.
OF_COUNTERS = {"rate", "irate", "increase", "resets"}
OF_GAUGES = {"avg_over_time", "max_over_time", "min_over_time", "predict_linear", "deriv", "delta"}
# Grafana's variables, each with a value that parses.
VARIABLES = {"$__rate_interval": "5m", "$__range": "3h", "$__interval": "1m"}
WORDS = re.compile(r"[\w /.-]+(\|[\w /.-]+)*")


class Wrong(Exception):
    """A query is invalid."""


class Query:
    """A query: the labels of its result, and the metrics that it uses."""

    def __init__(self, text, metrics, words):
        """`words(metric, label)` returns label values that are valid even if they were not seen."""
        self.metrics, self.words = metrics, words
        self.asked, self.numbers = set(), []
        for variable, value in VARIABLES.items():
            text = text.replace(variable, value)
        try:
            parsed = promql.parse(text)
        except ValueError as error:
            raise Wrong(f"cannot be parsed: {error}") from error
        self.labels = self.of(parsed)

    def of(self, expr):
        """The labels of the result of `expr`; None for a number."""
        return getattr(self, "of_" + type(expr).__name__)(expr)

    def of_NumberLiteral(self, expr):
        self.numbers.append(expr.val)

    def of_StringLiteral(self, _):
        return None

    def of_ParenExpr(self, expr):
        return self.of(expr.expr)

    def of_UnaryExpr(self, expr):
        return self.of(expr.expr)

    def of_SubqueryExpr(self, expr):
        return self.of(expr.expr)

    def of_MatrixSelector(self, expr):
        return self.of(expr.vector_selector)

    def of_VectorSelector(self, expr):
        name = expr.name
        matchers = [(str(m.op), m.name, m.value) for m in expr.matchers.matchers]
        self.asked.add(name)
        if name in OF_PROMETHEUS:
            labels = {}
        elif name in self.metrics:
            labels = self.metrics[name].labels
        else:
            raise Wrong(f"there is no metric {name}")
        for _, label, value in matchers:
            if label in OF_TARGET:
                continue
            if label not in labels:
                raise Wrong(f"{name} has no label {label}, only {', '.join(sorted(labels)) or 'none'}")
            self.check_value(name, label, value, labels[label])
        return set(labels) | OF_TARGET

    def check_value(self, name, label, value, seen):
        """Checks that a value was seen or is otherwise known; for a regular expression, that it matches
        one."""
        known = seen | self.words(name, label)
        if WORDS.fullmatch(value) and "." not in value.replace(".v1.", ""):
            missing = [word for word in value.split("|") if word not in known]
        else:
            missing = [] if any(re.fullmatch(value, word) for word in known) else [value]
        if missing:
            raise Wrong(f"{name} never has {label}={missing[0]!r}, only {', '.join(sorted(known))}")

    def of_Call(self, expr):
        function = expr.func.name
        if function == "absent":
            self.of(expr.args[0])
            return set(OF_TARGET)
        labels = [self.of(arg) for arg in expr.args]
        of_metric = next((found for found in labels if found is not None), None)
        if function in OF_COUNTERS | OF_GAUGES:
            name = expr.args[0].vector_selector.name
            counts = self.metrics[name].type in ("counter", "histogram")
            if counts != (function in OF_COUNTERS):
                raise Wrong(f"{function} of {name}, which is a {self.metrics[name].type}")
        if function == "histogram_quantile":
            if "le" not in of_metric:
                raise Wrong("histogram_quantile of a metric without the label le")
            return of_metric - {"le"}
        return of_metric

    def of_AggregateExpr(self, expr):
        labels = self.of(expr.expr)
        if expr.modifier is None:
            return set()
        named = set(expr.modifier.labels)
        if unknown := named - labels:
            raise Wrong(f"{expr.op} {expr.modifier}: there is no label {', '.join(unknown)}")
        by = expr.modifier.type == promql.AggModifierType.By
        return named if by else labels - named

    def of_BinaryExpr(self, expr):
        left, right = self.of(expr.lhs), self.of(expr.rhs)
        if left is None or right is None:
            return right if left is None else left
        operator, matching = str(expr.op), expr.modifier and expr.modifier.matching
        if operator == "or":
            return left | right
        if matching is None:
            if left != right:
                raise Wrong(f"{operator}: {sorted(left)} and {sorted(right)} never match")
            return left
        if unknown := set(matching.labels) - (left & right):
            raise Wrong(f"{operator} {matching}: not on both sides: {', '.join(unknown)}")
        many = expr.modifier.card != promql.VectorMatchCardinality.OneToOne
        return left if many or operator in ("and", "unless") else set(matching.labels)
