"""compose.scale.yaml, its proxy and its stores: valid, hardened and consistent."""

import re
import shutil
import subprocess
import tomllib
import unittest
from urllib.parse import urlsplit

from compose import ComposeFile, image_environment, instructions, required
from files import (
    DEFAULTS,
    DEPLOY,
    ROOT,
    VERSION,
    documents,
    drain_times,
    read,
    report,
    seconds,
    settings_in_force,
)

PROXY = "deploy/proxy/haproxy.cfg"
OURS = ("server", "worker", "migrate")


def timeout(name):
    return seconds(re.search(rf"^\s*timeout {name} (\w+)$", read(PROXY), flags=re.M)[1])


class Scale(ComposeFile, unittest.TestCase):
    FILE = "deploy/compose.scale.yaml"
    PROFILES = {"prometheus": "monitoring", "grafana": "monitoring"}

    def settings(self, name):
        given = self.services[name]["environment"]
        return settings_in_force(image_environment() | given)

    def test_servers_and_workers_run_the_image_and_are_stateless(self):
        of = instructions()
        for name in OURS:
            with self.subTest(name):
                service = self.services[name]
                self.assertEqual(service["image"], f"whereabouts:{VERSION}")
                self.assertEqual(service["user"], of["USER"][0])
                self.assertIn(of["VOLUME"][0], [one.split(":")[0] for one in service["tmpfs"]])
                self.assertNotIn("volumes", service)
                self.assertGreater(seconds(service["stop_grace_period"]), drain_times())
                self.assertGreater(service["ulimits"]["nofile"], DEFAULTS["server"]["max_connections"])
        for name in ("server", "worker"):
            self.assertEqual(
                " ".join(self.services[name]["healthcheck"]["test"]), "CMD whereabouts healthcheck"
            )
        commands = [" ".join(self.services[name]["command"]) for name in OURS]
        self.assertEqual(commands, ["serve --no-workers", "worker", "migrate"])

    def test_no_service_runs_as_root_and_logs_are_bounded(self):
        for name, service in self.services.items():
            with self.subTest(name):
                self.assertIn("max-size", service["logging"]["options"])
                self.assertIn("max-file", service["logging"]["options"])
                # The images of Prometheus and Grafana set their own user.
                if name not in self.PROFILES:
                    self.assertRegex(service["user"], r"^[1-9]\d+:[1-9]\d+$")

    def test_each_service_starts_after_its_dependencies(self):
        for name, service in self.services.items():
            needed = service.get("depends_on", {})
            for other, how in needed.items() if isinstance(needed, dict) else []:
                with self.subTest(name, needs=other):
                    ends = self.services[other]["restart"] == "no"
                    known = "service_completed_successfully" if ends else "service_healthy"
                    self.assertEqual(how["condition"], known)
                    if not ends:
                        self.assertIn("test", self.services[other].get("healthcheck", {}))
        for name in ("server", "worker"):
            self.assertEqual(set(self.services[name]["depends_on"]), {"migrate", "database", "objects"})

    def test_servers_and_workers_find_their_stores(self):
        database, objects = self.services["database"], self.services["objects"]
        garage = tomllib.loads(read("deploy/objects/garage.toml"))
        for name in OURS:
            with self.subTest(name):
                settings = self.settings(name)
                # The program hides the URL, because it may contain a password.
                self.assertEqual(settings["database"]["url"], "[hidden]")
                address = urlsplit(self.services[name]["environment"]["WHEREABOUTS_DATABASE__URL"])
                made = read("deploy/database/whereabouts.sh")
                self.assertEqual(address.hostname, "database")
                self.assertIn(f"CREATE ROLE {address.username} ", made)
                self.assertIn(f"CREATE DATABASE {address.path[1:]} ", made)
                self.assertEqual(address.password, database["environment"]["WHEREABOUTS_DATABASE_PASSWORD"])
                bucket, endpoint = (
                    urlsplit(settings["objects"]["url"]),
                    urlsplit(settings["objects"]["endpoint"]),
                )
                self.assertEqual(bucket.hostname, objects["environment"]["GARAGE_DEFAULT_BUCKET"])
                self.assertEqual(f"0.0.0.0:{endpoint.port}", garage["s3_api"]["api_bind_addr"])
                self.assertEqual(endpoint.hostname, "objects")
                self.assertEqual(settings["objects"]["allow_http"], endpoint.scheme == "http")
                self.assertEqual(settings["objects"]["region"], garage["s3_api"]["s3_region"])
                given = self.services[name]["environment"]
                for ours, theirs in (
                    ("AWS_ACCESS_KEY_ID", "GARAGE_DEFAULT_ACCESS_KEY"),
                    ("AWS_SECRET_ACCESS_KEY", "GARAGE_DEFAULT_SECRET_KEY"),
                ):
                    self.assertEqual(given[ours], objects["environment"][theirs])
                self.assertLessEqual({"default", "stores"}, set(self.services[name]["networks"]))
        self.assertIs(self.file["networks"]["stores"]["internal"], True)
        for name in ("database", "objects"):
            self.assertEqual(self.services[name]["networks"], ["stores"])
            self.assertNotIn("ports", self.services[name])
        mounts = [one["target"] for one in objects["volumes"]]
        for folder in (garage["metadata_dir"], garage["data_dir"]):
            self.assertTrue(any(folder.startswith(mount + "/") for mount in mounts), folder)
        self.assertTrue(garage["metadata_fsync"] and garage["data_fsync"])
        report(f"{self.FILE}: database, bucket, addresses, regions and keys are the same on both sides")

    def test_the_database_accepts_the_connections_of_all_processes(self):
        [most] = [int(one.split("=")[1]) for one in self.services["database"]["command"] if "max_conn" in one]
        processes = sum(self.services[name]["deploy"].get("replicas", 1) for name in OURS)
        # Twice, to leave room for scaling, plus some for operators.
        self.assertLess(2 * processes * DEFAULTS["database"]["max_connections"] + 10, most)

    def test_the_required_variables_are_in_the_example(self):
        example = read("deploy/scale.env.example")
        asked = set(re.findall(r"\$\{(\w+):", read(self.FILE)))
        mentioned = set(re.findall(r"^(?:# )?([A-Z_]+)=", example, flags=re.M))
        self.assertEqual(asked, mentioned)
        empty = set(re.findall(r"^([A-Z_]+)=$", example, flags=re.M))
        self.assertLessEqual(required(read(self.FILE)), empty)
        defaults = dict(re.findall(r"^# ([A-Z_]+)=(.+)$", example, flags=re.M))
        for name, value in re.findall(r"\$\{(\w+):-([^}]+)\}", read(self.FILE)):
            self.assertEqual(defaults[name], value, name)
        self.assertIn("/deploy/scale.env", read(".gitignore").splitlines())
        self.assertIn("deploy/scale.env", read(".dockerignore").splitlines())

    def test_the_proxy_finds_the_servers_and_has_long_enough_timeouts(self):
        config, proxy = read(PROXY), self.services["proxy"]
        found = re.findall(r"server-template \w+ 1-(\d+) (\w+):(\d+)", config)
        self.assertEqual(len(found), 2)
        for most, name, port in found:
            self.assertGreaterEqual(int(most), self.services["server"]["deploy"]["replicas"])
            self.assertEqual([name, [port]], ["server", instructions()["EXPOSE"]])
        self.assertIn(f"bind :{proxy['ports'][0]['target']}\n", config)
        [health] = re.findall(r"bind (127.0.0.1:\d+)", config)
        self.assertIn(f"http://{health}/healthz", proxy["healthcheck"]["test"])
        silence = max(
            DEFAULTS["server"]["stream_idle_s"],
            DEFAULTS["server"]["request_timeout_s"],
            DEFAULTS["jobs"]["max_wait_s"],
        )
        for side in ("client", "server"):
            self.assertGreater(timeout(side), silence)
        for name in ("http-request", "http-keep-alive"):
            self.assertLessEqual(timeout(name), DEFAULTS["server"]["header_timeout_s"])
        self.assertIn("retry-on conn-failure\n", config, "a request that a server has received must not be retried")
        [connections] = re.findall(r"maxconn (\d+)", config)
        self.assertGreater(proxy["ulimits"]["nofile"], 2 * int(connections))
        self.assertGreater(
            seconds(proxy["stop_grace_period"]), seconds(re.search(r"hard-stop-after (\w+)", config)[1])
        )
        if shutil.which("haproxy"):
            ran = subprocess.run(
                ["haproxy", "-c", "-f", ROOT / PROXY], capture_output=True, text=True, check=False
            )
            self.assertEqual(ran.returncode, 0, ran.stdout + ran.stderr)
            report(f"{PROXY}: accepted by haproxy")

    def test_prometheus_finds_each_server_and_each_worker(self):
        [config] = documents("deploy/prometheus/scale.yml")
        [job] = config["scrape_configs"]
        [found] = job["dns_sd_configs"]
        self.assertEqual(found["names"], ["server", "worker"])
        self.assertLessEqual(set(found["names"]), set(self.services))
        self.assertEqual([str(found["port"])], instructions()["EXPOSE"])
        self.assertEqual({one["target_label"] for one in job["relabel_configs"]}, {"deployment", "role"})

    def test_the_image_is_built_by_one_service(self):
        built = [name for name, service in self.services.items() if "build" in service]
        self.assertEqual(built, ["server"])
        build = self.services["server"]["build"]
        self.assertTrue((DEPLOY / build["context"] / build["dockerfile"]).is_file())


if __name__ == "__main__":
    unittest.main()
