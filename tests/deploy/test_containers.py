"""The Dockerfile and compose.yaml: valid, closed, and of one mind."""

import re
import subprocess
import unittest

import yaml
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
    seconds,
    settings_in_force,
    told,
)

COMPOSE = "deploy/compose.yaml"


def instructions():
    """The instructions of the Dockerfile's last stage, by name."""
    text = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", read("Dockerfile"), flags=re.M))
    lines = re.findall(r"^([A-Z]+) (.*)$", text[text.rindex("\nFROM ") :], flags=re.M)
    return {name: [rest for other, rest in lines if other == name] for name, _ in lines}


def image_environment():
    return dict(re.findall(r"(\w+)=(\S+)", " ".join(instructions()["ENV"])))


def without_variables(text):
    """A compose file with the default of each variable."""
    return re.sub(r"\$\{(\w+):-([^}]*)\}", r"\2", text)


def has_docker_compose():
    try:
        return (
            subprocess.run(["docker", "compose", "version"], capture_output=True, check=False).returncode == 0
        )
    except FileNotFoundError:
        return False


class Image(unittest.TestCase):
    def test_its_settings_exist_and_hold_together(self):
        of = instructions()
        check_settings(self, "Dockerfile")
        settings = settings_in_force(image_environment())
        _, port = settings["server"]["listen"].split(":")
        self.assertEqual(of["EXPOSE"], [port])
        self.assertEqual(of["VOLUME"], [settings["data"]["dir"]])
        self.assertTrue(settings["model"]["assets"].startswith(settings["data"]["dir"] + "/"))
        told(f"Dockerfile: {len(image_environment())} settings exist; volume and port are theirs")

    def test_it_runs_as_nobody_in_particular_and_says_how_it_is(self):
        of = instructions()
        self.assertRegex(of["USER"][0], r"^[1-9]\d+:[1-9]\d+$")
        self.assertIn('CMD ["whereabouts", "healthcheck"]', of["HEALTHCHECK"][0])
        self.assertEqual(of["STOPSIGNAL"], ["SIGTERM"])

    def test_what_it_copies_is_there(self):
        stages = re.findall(r"^COPY (?!--from)(.*) \S+$", read("Dockerfile"), flags=re.M)
        for sources in stages:
            for source in sources.split():
                self.assertTrue((ROOT / source).exists(), source)


class Compose(unittest.TestCase):
    def setUp(self):
        self.text = without_variables(read(COMPOSE))
        self.file = yaml.safe_load(self.text)
        self.services = self.file["services"]
        self.server = self.services["whereabouts"]

    def test_it_is_what_the_specification_allows(self):
        PyCompose.from_yaml(self.text).validate()
        self.assertNotIn("${", self.text, "a variable without a default")
        by_docker = [
            "docker",
            "compose",
            "--file",
            ROOT / COMPOSE,
            "--profile",
            "monitoring",
            "config",
            "--quiet",
        ]
        if has_docker_compose():
            ran = subprocess.run(by_docker, capture_output=True, text=True, check=False)
            self.assertEqual(ran.returncode, 0, ran.stderr)
        told(f"{COMPOSE}: {len(self.services)} services, valid by the Compose specification")

    def test_every_service_is_closed(self):
        for name, service in self.services.items():
            with self.subTest(name):
                self.assertIs(service.get("read_only"), True)
                self.assertEqual(service.get("cap_drop"), ["ALL"])
                self.assertEqual(service.get("security_opt"), ["no-new-privileges:true"])
                self.assertLessEqual({"cpus", "memory", "pids"}, set(service["deploy"]["resources"]["limits"]))
                self.assertRegex(service["image"], r":v?\d+\.\d+\.\d+$", "an image without its version")
                for port in service["ports"]:
                    self.assertEqual(port["host_ip"], "127.0.0.1", "open to the network")
                self.assertEqual("profiles" in service, name != "whereabouts")

    def test_it_is_of_one_mind_with_the_image(self):
        of, server = instructions(), self.server
        self.assertEqual(server["image"], f"whereabouts:{VERSION}")
        self.assertTrue((DEPLOY / server["build"]["context"] / server["build"]["dockerfile"]).is_file())
        self.assertEqual(server["user"], of["USER"][0])
        self.assertEqual([str(port["target"]) for port in server["ports"]], of["EXPOSE"])
        self.assertEqual([volume["target"] for volume in server["volumes"]], of["VOLUME"])
        self.assertEqual(" ".join(server["healthcheck"]["test"]), "CMD whereabouts healthcheck")
        self.assertGreater(seconds(server["stop_grace_period"]), drain_times())
        self.assertGreater(server["ulimits"]["nofile"], DEFAULTS["server"]["max_connections"])

    def test_its_settings_exist(self):
        check_settings(self, COMPOSE)
        settings_in_force(image_environment() | self.server["environment"])
        told(f"{COMPOSE}: `whereabouts config` takes its settings together with those of the image")

    def test_what_it_mounts_is_there_and_used(self):
        for name, service in self.services.items():
            with self.subTest(name):
                for mount in service["volumes"]:
                    if mount["type"] == "bind":
                        self.assertTrue((DEPLOY / mount["source"]).exists(), mount["source"])
                    else:
                        self.assertIn(mount["source"], self.file["volumes"])
                for secret in service.get("secrets", []):
                    self.assertIn(secret, self.file["secrets"])

    def test_prometheus_and_grafana_find_what_they_look_for(self):
        prometheus, grafana = self.services["prometheus"], self.services["grafana"]
        [config] = documents("deploy/prometheus/prometheus.yml")
        [job] = config["scrape_configs"]
        target = f"whereabouts:{self.server['ports'][0]['target']}"
        self.assertEqual(job["static_configs"], [{"targets": [target]}])
        self.assertEqual(job["authorization"]["credentials_file"], f"/run/secrets/{prometheus['secrets'][0]}")
        file = next(one.split("=")[1] for one in prometheus["command"] if "config.file" in one)
        mounts = {mount["target"]: mount["source"] for mount in prometheus["volumes"]}
        self.assertTrue((DEPLOY / mounts[file.rsplit("/", 1)[0]] / file.rsplit("/", 1)[1]).is_file())

        mounts = {mount["target"]: mount["source"] for mount in grafana["volumes"]}
        [provider] = documents("deploy/grafana/provisioning/dashboards/whereabouts.yaml")[0]["providers"]
        board = f"{provider['options']['path']}/whereabouts.json"
        self.assertEqual(mounts[board], "./grafana/whereabouts.json")
        self.assertEqual(grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"], board)
        [source] = documents("deploy/grafana/provisioning/datasources/prometheus.yaml")[0]["datasources"]
        self.assertEqual(source["type"], "prometheus")
        self.assertEqual(source["url"], f"http://prometheus:{prometheus['ports'][0]['target']}")
        self.assertEqual(source["jsonData"]["timeInterval"], config["global"]["scrape_interval"])
        password = grafana["environment"]["GF_SECURITY_ADMIN_PASSWORD__FILE"]
        self.assertEqual(password, f"/run/secrets/{grafana['secrets'][0]}")
        told(
            "prometheus.yml and Grafana's provisioning: targets, keys, mounts and addresses are compose.yaml's"
        )


if __name__ == "__main__":
    unittest.main()
