"""The manifests of many servers and workers: valid, within the profile `restricted`, and consistent."""

import re
import unittest

from compose import image_environment, instructions
from files import DEFAULTS, VERSION, documents, drain_times, read, report, settings_in_force
from manifests import built, check_probes, check_resources, check_restricted, settings_of


def matches(selector, labels):
    return set(selector.items()) <= set(labels.items())


class Scale(unittest.TestCase):
    def setUp(self):
        self.resources, self.tool = built("scale")
        self.deployments = {
            resource["metadata"]["labels"]["app.kubernetes.io/component"]: resource
            for resource in self.resources
            if resource["kind"] == "Deployment"
        }
        self.pods = {name: one["spec"]["template"]["spec"] for name, one in self.deployments.items()}
        self.labels = {
            name: one["spec"]["template"]["metadata"]["labels"] for name, one in self.deployments.items()
        }
        [self.maintenance] = documents("deploy/kubernetes/scale-maintenance.yaml")

    def only(self, kind):
        [resource] = [one for one in self.resources if one["kind"] == kind]
        return resource

    def test_every_resource_is_valid(self):
        check_resources(self, "scale", [*self.resources, self.maintenance], self.tool)

    def test_there_are_servers_and_workers_within_the_profile_restricted(self):
        self.assertEqual(set(self.pods), {"server", "worker"})
        for name, pod in [*self.pods.items(), ("maintenance", self.maintenance["spec"])]:
            with self.subTest(name):
                check_restricted(self, pod)
                self.assertEqual(pod["serviceAccountName"], "whereabouts")
                self.assertFalse([one for one in pod["volumes"] if "emptyDir" not in one], "pods must be stateless")
                mounts = [one["mountPath"] for one in pod["containers"][0]["volumeMounts"]]
                self.assertEqual(mounts, [*instructions()["VOLUME"], "/tmp"])
        self.assertIs(self.only("ServiceAccount")["automountServiceAccountToken"], False)
        self.assertFalse([one for one in self.resources if one["kind"] == "Secret"])

    def test_servers_roll_without_downtime_and_shut_down_in_order(self):
        server = self.deployments["server"]["spec"]
        self.assertGreaterEqual(server["replicas"], 2)
        self.assertEqual(server["strategy"]["rollingUpdate"]["maxUnavailable"], 0)
        budget = self.only("PodDisruptionBudget")["spec"]
        self.assertTrue(matches(budget["selector"]["matchLabels"], self.labels["server"]))
        self.assertFalse(matches(budget["selector"]["matchLabels"], self.labels["worker"]))
        [container] = self.pods["server"]["containers"]
        pause = int(container["lifecycle"]["preStop"]["exec"]["command"][-1])
        self.assertGreater(self.pods["server"]["terminationGracePeriodSeconds"], pause + drain_times())
        self.assertGreater(self.pods["worker"]["terminationGracePeriodSeconds"], drain_times())
        self.assertIn("serve --no-workers", container["command"][-1])
        self.assertEqual(self.pods["worker"]["containers"][0]["args"], ["worker"])
        for name, pod in self.pods.items():
            check_probes(self, pod["containers"][0])
            [migrate] = pod["initContainers"]
            self.assertEqual(migrate["args"], ["migrate"])
            for spread in pod["topologySpreadConstraints"]:
                self.assertTrue(matches(spread["labelSelector"]["matchLabels"], self.labels[name]))

    def test_workers_are_scaled_by_a_metric_that_exists(self):
        scaler = self.only("HorizontalPodAutoscaler")["spec"]
        self.assertEqual(scaler["scaleTargetRef"]["name"], self.deployments["worker"]["metadata"]["name"])
        self.assertNotIn("replicas", self.deployments["worker"]["spec"], "it would override the autoscaler")
        [metric] = [one["external"]["metric"] for one in scaler["metrics"]]
        [rule] = documents("deploy/prometheus/adapter.yaml")[0]["rules"]["external"]
        self.assertEqual(rule["name"]["as"], metric["name"])
        self.assertTrue(rule["seriesQuery"].startswith(metric["name"] + "{"))
        self.assertIs(rule["resources"]["namespaced"], False)
        self.assertTrue(rule["metricsQuery"].startswith("max by (deployment) "), "the queue would be summed")
        [config] = documents("deploy/prometheus/kubernetes.yml")
        [job] = config["scrape_configs"]
        found = {one.get("target_label"): one["source_labels"] for one in job["relabel_configs"]}
        self.assertEqual(found["deployment"], ["__meta_kubernetes_namespace"])
        self.assertEqual(
            metric["selector"]["matchLabels"], {"deployment": self.only("Namespace")["metadata"]["name"]}
        )
        self.assertEqual(found["role"], ["__meta_kubernetes_pod_label_app_kubernetes_io_component"])
        kept = next(one["regex"] for one in job["relabel_configs"] if one.get("action") == "keep").split(";")
        for name, pod in self.pods.items():
            ports = [port["name"] for port in pod["containers"][0]["ports"]]
            self.assertEqual(kept, [self.labels[name]["app.kubernetes.io/name"], *ports])
        report(f"kubernetes/scale: workers are scaled by {metric['name']}, as in the adapter and the scrape config")

    def test_only_servers_receive_requests_and_all_pods_can_reach_their_stores(self):
        service = self.only("Service")["spec"]["selector"]
        self.assertTrue(matches(service, self.labels["server"]))
        self.assertFalse(matches(service, self.labels["worker"]))
        self.assertFalse(matches(service, self.maintenance["metadata"]["labels"]))
        policies = [one["spec"] for one in self.resources if one["kind"] == "NetworkPolicy"]
        for policy in policies:
            for labels in [*self.labels.values(), self.maintenance["metadata"]["labels"]]:
                self.assertTrue(matches(policy["podSelector"]["matchLabels"], labels))
        asked = {port["port"] for policy in policies for to in policy["egress"] for port in to["ports"]}
        self.assertLessEqual({53, 443, 5432}, asked)

    def test_names_and_versions_agree(self):
        if self.tool:
            for pod in self.pods.values():
                for container in pod["containers"] + pod["initContainers"]:
                    self.assertEqual(container["image"], f"whereabouts:{VERSION}")
                    [settings] = [source["configMapRef"]["name"] for source in container["envFrom"]]
                    self.assertEqual(settings, self.only("ConfigMap")["metadata"]["name"])
            spaces = {one["metadata"].get("namespace") for one in self.resources if one["kind"] != "Namespace"}
            self.assertEqual(spaces, {self.only("Namespace")["metadata"]["name"]})
        [container] = self.maintenance["spec"]["containers"]
        self.assertEqual(container["image"], f"whereabouts:{VERSION}")
        secrets = set(re.findall(r"create secret generic ([\w-]+)", read("docs/deploy.md")))
        referred = {
            variable["valueFrom"]["secretKeyRef"]["name"]
            for pod in [*self.pods.values(), self.maintenance["spec"]]
            for container in pod["containers"] + pod.get("initContainers", [])
            for variable in container["env"]
        }
        self.assertLessEqual(referred, secrets, "a secret that docs/deploy.md does not create")

    def test_settings_exist_and_are_consistent(self):
        _, settings = settings_of("scale")
        for name, pod in self.pods.items():
            [container] = pod["containers"]
            given = {one["name"]: "a-secret" for one in container["env"]}
            given["WHEREABOUTS_DATABASE__URL"] = "postgres://whereabouts:a-secret@db:5432/whereabouts"
            found = settings_in_force(image_environment() | settings | given)
            self.assertEqual(
                found["server"]["listen"].split(":")[1], str(container["ports"][0]["containerPort"])
            )
            report(f"kubernetes/scale: `whereabouts config` accepts the settings of a {name}")
        self.assertLessEqual(found["database"]["max_connections"], DEFAULTS["database"]["max_connections"])


if __name__ == "__main__":
    unittest.main()
