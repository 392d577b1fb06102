"""Checks the alert rules and the dashboard against /metrics of a server."""

import json
import re
import shutil
import subprocess
import tomllib
import unittest

import traffic
from files import (
    DEFAULTS,
    DEPLOY,
    METRIC,
    ROOT,
    SCRATCH,
    check_settings,
    dashboard,
    documents,
    read,
    report,
    seconds,
)
from queries import OF_TARGET, Query, Wrong

RULES = "deploy/prometheus/alerts.yaml"
METRICS = {}


def setUpModule():
    METRICS.update(traffic.make())
    report(f"/metrics: {len(METRICS)} names after the generated traffic")


def words(name, label):
    """Label values that need not have been seen: those in the help of a metric or in the reference."""
    known = set(re.findall(r"\w+", METRICS[name].help))
    if (name, label) == ("whereabouts_refused_total", "reason"):
        [row] = [line for line in read("docs/operations.md").splitlines() if f"{name}{{{label}}}" in line]
        known |= set(re.findall(r"`(\w+)`", row))
    if (name, label) == ("whereabouts_jobs_ended_total", "state"):
        states = json.loads(read("docs/openapi.json"))["components"]["schemas"]["JobState"]
        known |= set(states.get("enum", [])) | {one.get("const") for one in states.get("oneOf", [])}
        known |= {value for one in states.get("oneOf", []) for value in one.get("enum", [])}
    if label == "status":
        known |= {"500", "503", "504", "507"}
    return known


def families():
    """The names of metrics without histogram suffixes."""
    return {re.sub(r"_(bucket|sum|count)$", "", name) for name in METRICS}


def query(text):
    return Query(text, METRICS, words)


# Metrics from the shared database, which every process reports with the same value.
SHARED = {
    "whereabouts_db_bytes",
    "whereabouts_description_cache_bytes",
    "whereabouts_description_cache_entries",
    "whereabouts_index_bytes",
    "whereabouts_jobs_queued",
    "whereabouts_map_images",
    "whereabouts_mllm_money_today",
    "whereabouts_mllm_tokens_today",
    "whereabouts_oldest_job_seconds",
    "whereabouts_webhook_deliveries_waiting",
}


def check_shared(case, text):
    """Fails if a metric that every process of a deployment reports alike is summed or shown per process."""
    bare = re.sub(r"\{[^{}]*\}|\[\w+\]", "", text)
    for name in SHARED & set(METRIC.findall(bare)):
        once = rf"max by \((job, )?deployment(, map)?\) \((predict_linear\()?{name}\b"
        case.assertRegex(bare, once, f"{name} is the same number from every process")


class Rules(unittest.TestCase):
    def setUp(self):
        [file] = documents(RULES)
        self.assertEqual(list(file), ["groups"])
        self.rules = [rule for group in file["groups"] for rule in group["rules"]]

    def test_every_rule_is_complete(self):
        for rule in self.rules:
            with self.subTest(rule.get("alert")):
                self.assertLessEqual(set(rule), {"alert", "expr", "for", "labels", "annotations"})
                self.assertRegex(rule["alert"], r"^Whereabouts[A-Z]\w+$")
                self.assertRegex(rule.get("for", "0m"), r"^\d+[smh]$")
                self.assertIn(rule["labels"]["severity"], ("critical", "warning"))
                self.assertLessEqual({"summary", "action"}, set(rule["annotations"]))
        names = [rule["alert"] for rule in self.rules]
        self.assertEqual(len(names), len(set(names)), "two rules with the same name")
        named = re.findall(r"Whereabouts[A-Z]\w+", json.dumps(self.rules) + read("docs/deploy.md"))
        self.assertEqual(set(named) - set(names), set(), "rules that are mentioned and do not exist")

    def test_every_query_finds_its_metrics_and_labels(self):
        asked = set()
        for rule in self.rules:
            with self.subTest(rule["alert"]):
                try:
                    found = query(rule["expr"])
                except Wrong as wrong:
                    self.fail(f"{RULES}: {rule['alert']}: {wrong}")
                asked |= found.asked
                check_shared(self, rule["expr"])
                mentioned = set(re.findall(r"\$labels\.(\w+)", json.dumps(rule["annotations"])))
                self.assertEqual(mentioned - found.labels, set(), "labels that the alert lacks")
        report(f"{RULES}: {len(self.rules)} rules use {len(asked)} metrics, all of which exist")

    def test_numbers_that_repeat_a_setting_equal_its_default(self):
        for rule in self.rules:
            if "setting" not in rule["annotations"]:
                continue
            section, key = rule["annotations"]["setting"].split(".")
            with self.subTest(rule["alert"]):
                self.assertIn(key, DEFAULTS[section], "there is no such setting")
                self.assertIn(
                    DEFAULTS[section][key], query(rule["expr"]).numbers, f"default of {section}.{key}"
                )

    def test_the_settings_and_metrics_it_mentions_exist(self):
        text = read(RULES)
        check_settings(self, RULES, "docs/deploy.md")
        named = set(METRIC.findall(text + read("docs/deploy.md")))
        self.assertEqual(named - set(METRICS) - families(), set(), "metrics that are mentioned and do not exist")

    def test_the_binary_has_the_settings_of_this_tree(self):
        self.assertEqual(tomllib.loads((SCRATCH / "defaults.toml").read_text()), DEFAULTS, "the binary is outdated")

    @unittest.skipUnless(shutil.which("promtool"), "promtool is not installed")
    def test_promtool_accepts_the_rules_and_they_fire_as_expected(self):
        shutil.copy(ROOT / RULES, SCRATCH)
        for name in ("prometheus.yml", "scale.yml"):
            # The key file exists only in the container.
            config = read(f"deploy/prometheus/{name}").replace(
                "/run/secrets/metrics_key", str(SCRATCH / "operator.key")
            )
            (SCRATCH / name).write_text(config)
        for what in (
            ["check", "config", SCRATCH / "prometheus.yml"],
            ["check", "config", SCRATCH / "scale.yml"],
            ["test", "rules", ROOT / "tests/deploy/alerts_test.yaml"],
        ):
            ran = subprocess.run(["promtool", *what], capture_output=True, text=True, check=False)
            self.assertEqual(ran.returncode, 0, ran.stdout + ran.stderr)
        report("promtool: accepts both configurations and the rules, which fire in alerts_test.yaml as expected")


class Dashboard(unittest.TestCase):
    def setUp(self):
        self.board = dashboard()
        self.panels = [panel for panel in self.board["panels"] if panel["type"] != "row"]

    def test_panels_do_not_overlap(self):
        self.assertGreaterEqual(self.board["schemaVersion"], 41)
        ids = [panel["id"] for panel in self.board["panels"]]
        self.assertEqual(len(ids), len(set(ids)), "two panels with the same id")
        taken = {}
        for panel in self.board["panels"]:
            place = panel["gridPos"]
            self.assertLessEqual(place["x"] + place["w"], 24, panel["title"])
            for x in range(place["x"], place["x"] + place["w"]):
                for y in range(place["y"], place["y"] + place["h"]):
                    self.assertNotIn((x, y), taken, f"{panel['title']} overlaps {taken.get((x, y))}")
                    taken[x, y] = panel["title"]

    def test_every_query_of_every_panel_finds_its_metrics_and_labels(self):
        asked, queries = set(), 0
        for panel in self.panels:
            with self.subTest(panel["title"]):
                self.assertTrue(panel["targets"], "the panel has no query")
                self.assertEqual(panel["datasource"]["uid"], "${datasource}")
                for target in panel["targets"]:
                    try:
                        found = query(target["expr"])
                    except Wrong as wrong:
                        self.fail(f"whereabouts.json: {panel['title']}: {wrong}")
                    legend = set(re.findall(r"{{\s*(\w+)\s*}}", target["legendFormat"]))
                    self.assertEqual(legend - found.labels, set(), "labels in the legend that the query lacks")
                    check_shared(self, target["expr"])
                    asked |= found.asked
                    queries += 1
        for annotation in self.board["annotations"]["list"]:
            query(annotation["expr"])
        for variable in self.board["templating"]["list"]:
            if variable["type"] == "query":
                series, label = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["definition"]).groups()
                self.assertIn(label, query(series).labels | OF_TARGET)
        report(f"whereabouts.json: {len(self.panels)} panels, {queries} queries, {len(asked)} metrics, all existing")
        missing = families() - {re.sub(r"_(bucket|sum|count)$", "", name) for name in asked}
        self.assertEqual(missing, set(), "metrics that no panel shows")

    def test_every_metric_is_in_the_reference(self):
        rows = re.findall(r"^\| `(whereabouts_\w+)(?:\{([\w, ]+)\})?` \|", read("docs/operations.md"), re.M)
        listed = {name: set(labels.replace(",", " ").split()) for name, labels in rows}
        there = {name: set() for name in families()}
        for name, metric in METRICS.items():
            there[re.sub(r"_(bucket|sum|count)$", "", name)] |= set(metric.labels) - {"le"}
        self.assertEqual(listed, there, "docs/operations.md, Metrics")

    def test_the_settings_it_mentions_exist(self):
        check_settings(self, "deploy/grafana/whereabouts.json")


class Scraping(unittest.TestCase):
    def test_metrics_need_an_operator_key(self):
        for role, status in ((None, 401), ("robot", 403), ("operator", 200)):
            self.assertEqual(traffic.ask("GET", "/metrics", role=role)[0], status, role)
        [job] = documents("deploy/prometheus/prometheus.yml")[0]["scrape_configs"]
        self.assertEqual(job["authorization"]["type"], "Bearer")
        report("/metrics: 401 without a key, 403 with a robot key, 200 with an operator key")

    def test_the_job_in_the_rules_is_the_scraped_job(self):
        named = set(re.findall(r'job="(\w+)"', read(RULES) + json.dumps(dashboard()).replace('\\"', '"')))
        for name in ("prometheus.yml", "scale.yml", "kubernetes.yml"):
            with self.subTest(name):
                [config] = documents(f"deploy/prometheus/{name}")
                [job] = config["scrape_configs"]
                self.assertEqual(job["metrics_path"], "/metrics")
                self.assertEqual(job["authorization"]["type"], "Bearer")
                self.assertEqual(named, {job["job_name"]})
                for file in config.get("rule_files", []):
                    self.assertTrue((DEPLOY / "prometheus" / file).is_file(), file)
                if times := config.get("global"):
                    self.assertLess(seconds(times["scrape_timeout"]), seconds(times["scrape_interval"]))

    def test_the_metric_of_the_autoscaler_exists(self):
        [rule] = documents("deploy/prometheus/adapter.yaml")[0]["rules"]["external"]
        series = query(rule["seriesQuery"])
        asked = rule["metricsQuery"].replace("<<.Series>>", rule["name"]["as"])
        asked = query(asked.replace("<<.LabelMatchers>>", 'deployment="whereabouts"'))
        self.assertEqual(series.asked, asked.asked)


if __name__ == "__main__":
    unittest.main()
