"""The Dockerfile and compose.yaml: valid, hardened and consistent."""

import re
import unittest

import yaml
from compose import ComposeFile, image_environment, instructions, with_variables
from compose_spec import PyCompose
from files import (
    DEFAULTS,
    DEPLOY,
    ROOT,
    VERSION,
    check_settings,
    documents,
    drain_times,
    read,
    report,
    seconds,
    settings_in_force,
)


class Image(unittest.TestCase):
    def test_its_settings_exist_and_are_consistent(self):
        of = instructions()
        check_settings(self, "Dockerfile")
        settings = settings_in_force(image_environment())
        _, port = settings["server"]["listen"].split(":")
        self.assertEqual(of["EXPOSE"], [port])
        self.assertEqual(of["VOLUME"], [settings["data"]["dir"]])
        self.assertTrue(settings["model"]["assets"].startswith(settings["data"]["dir"] + "/"))
        report(f"Dockerfile: {len(image_environment())} settings exist and match the volume and the port")

    def test_it_runs_as_an_unprivileged_user_and_has_a_health_check(self):
        of = instructions()
        self.assertRegex(of["USER"][0], r"^[1-9]\d+:[1-9]\d+$")
        self.assertIn('CMD ["whereabouts", "healthcheck"]', of["HEALTHCHECK"][0])
        self.assertEqual(of["STOPSIGNAL"], ["SIGTERM"])

    def test_the_files_it_copies_exist(self):
        stages = re.findall(r"^COPY (?!--from)(.*) \S+$", read("Dockerfile"), flags=re.M)
        for sources in stages:
            for source in sources.split():
                self.assertTrue((ROOT / source).exists(), source)


class Compose(ComposeFile, unittest.TestCase):
    FILE = "deploy/compose.yaml"
    PROFILES = {"prometheus": "monitoring", "grafana": "monitoring"}

    def setUp(self):
        super().setUp()
        self.server = self.services["whereabouts"]

    def test_it_is_consistent_with_the_image(self):
        of, server = instructions(), self.server
        self.assertEqual(server["image"], f"whereabouts:{VERSION}")
        self.assertTrue((DEPLOY / server["build"]["context"] / server["build"]["dockerfile"]).is_file())
        self.assertEqual(server["user"], of["USER"][0])
        self.assertEqual([str(port["target"]) for port in server["ports"]], of["EXPOSE"])
        self.assertEqual([volume["target"] for volume in server["volumes"]], of["VOLUME"])
        self.assertEqual(" ".join(server["healthcheck"]["test"]), "CMD whereabouts healthcheck")
        self.assertGreater(seconds(server["stop_grace_period"]), drain_times())
        self.assertGreater(server["ulimits"]["nofile"], DEFAULTS["server"]["max_connections"])

    def test_its_settings_are_consistent(self):
        settings_in_force(image_environment() | self.server["environment"])
        report(f"{self.FILE}: `whereabouts config` accepts its settings combined with those of the image")

    def test_prometheus_finds_the_server(self):
        [config] = documents("deploy/prometheus/prometheus.yml")
        [job] = config["scrape_configs"]
        target = f"whereabouts:{self.server['ports'][0]['target']}"
        self.assertEqual([one["targets"] for one in job["static_configs"]], [[target]])


class LocalMllm(unittest.TestCase):
    FILE = "deploy/compose.local-mllm.yaml"

    def setUp(self):
        self.file = yaml.safe_load(with_variables(read(self.FILE)))
        self.services = self.file["services"]

    def test_it_conforms_to_the_compose_specification_and_its_settings_exist(self):
        PyCompose.from_yaml(yaml.safe_dump(self.file)).validate()
        check_settings(self, self.FILE)
        settings_in_force(image_environment() | self.services["whereabouts"]["environment"])
        report(f"{self.FILE}: valid, and `whereabouts config` accepts its settings")

    def test_the_models_server_has_no_way_out_and_is_found(self):
        llama, server = self.services["llama"], self.services["whereabouts"]
        self.assertTrue(all(self.file["networks"][name]["internal"] for name in llama["networks"]))
        self.assertNotIn("ports", llama)
        port = llama["command"][llama["command"].index("--port") + 1]
        self.assertEqual(server["environment"]["WHEREABOUTS_MLLM__BASE_URL"], f"http://llama:{port}/v1")
        self.assertEqual(server["depends_on"]["llama"]["condition"], "service_healthy")

    def test_both_are_hardened(self):
        for name, service in self.services.items():
            with self.subTest(name):
                self.assertTrue(service["read_only"])
                self.assertEqual(service["cap_drop"], ["ALL"])
                self.assertIn("no-new-privileges:true", service["security_opt"])


if __name__ == "__main__":
    unittest.main()
