"""The manifests of one server: valid, within the profile `restricted`, and consistent."""

import unittest

import traffic
from compose import image_environment, instructions
from files import ROOT, VERSION, check_settings, documents, drain_times, read, report, settings_in_force
from manifests import FOLDER, built, check_probes, check_resources, check_restricted, settings_of


class Kubernetes(unittest.TestCase):
    def setUp(self):
        self.resources, self.tool = built("embedded")
        self.by_kind = {resource["kind"]: resource for resource in self.resources}
        self.set = self.by_kind["StatefulSet"]
        self.pod = self.set["spec"]["template"]["spec"]
        [self.server] = self.pod["containers"]
        [self.maintenance] = documents("deploy/kubernetes/maintenance.yaml")

    def test_every_resource_is_valid(self):
        check_resources(self, "embedded", [*self.resources, self.maintenance], self.tool)

    def test_pods_conform_to_the_profile_restricted(self):
        for pod in (self.pod, self.maintenance["spec"]):
            check_restricted(self, pod)
        labels = self.by_kind["Namespace"]["metadata"]["labels"]
        self.assertEqual(labels["pod-security.kubernetes.io/enforce"], "restricted")

    def test_only_one_process_has_the_volume(self):
        self.assertEqual(self.set["spec"]["replicas"], 1)
        self.assertGreater(self.pod["terminationGracePeriodSeconds"], drain_times())
        claim = self.by_kind["PersistentVolumeClaim"]
        self.assertEqual(claim["spec"]["accessModes"], ["ReadWriteOncePod"])
        for pod in (self.pod, self.maintenance["spec"]):
            claims = [
                volume["persistentVolumeClaim"]["claimName"]
                for volume in pod["volumes"]
                if "persistentVolumeClaim" in volume
            ]
            self.assertEqual(claims, [claim["metadata"]["name"]])

    def test_names_and_ports_agree(self):
        service, policy = self.by_kind["Service"]["spec"], self.by_kind["NetworkPolicy"]["spec"]
        [port] = self.server["ports"]
        self.assertEqual([str(port["containerPort"])], instructions()["EXPOSE"])
        self.assertEqual(service["ports"][0]["targetPort"], port["name"])
        self.assertEqual(service["ports"][0]["appProtocol"], "kubernetes.io/h2c")
        self.assertEqual(policy["ingress"][0]["ports"][0]["port"], port["name"])
        labels = self.set["spec"]["template"]["metadata"]["labels"]
        for selector in (
            service["selector"],
            policy["podSelector"]["matchLabels"],
            self.set["spec"]["selector"]["matchLabels"],
        ):
            self.assertLessEqual(set(selector.items()), set(labels.items()))
        maintenance = self.maintenance["metadata"]["labels"]
        self.assertFalse(
            set(service["selector"].items()) <= set(maintenance.items()),
            "requests would reach the maintenance pod",
        )
        self.assertEqual(self.set["spec"]["serviceName"], self.by_kind["Service"]["metadata"]["name"])
        self.assertEqual(self.pod["serviceAccountName"], self.by_kind["ServiceAccount"]["metadata"]["name"])
        if self.tool:
            self.assertEqual(self.server["image"], f"whereabouts:{VERSION}")
            [settings] = [source["configMapRef"]["name"] for source in self.server["envFrom"]]
            self.assertEqual(settings, self.by_kind["ConfigMap"]["metadata"]["name"])
            spaces = {
                resource["metadata"].get("namespace")
                for resource in self.resources
                if resource["kind"] != "Namespace"
            }
            self.assertEqual(spaces, {self.by_kind["Namespace"]["metadata"]["name"]})
        [container] = self.maintenance["spec"]["containers"]
        self.assertEqual(container["image"], f"whereabouts:{VERSION}")

    def test_settings_exist_and_stay_in_the_volume(self):
        for file in [*FOLDER.glob("*.yaml"), *FOLDER.glob("*/*.yaml")]:
            check_settings(self, file.relative_to(ROOT))
        name, settings = settings_of("embedded")
        self.assertEqual(name, "whereabouts")
        given = {variable["name"]: variable.get("value", "a-secret") for variable in self.server["env"]}
        found = settings_in_force(image_environment() | settings | given)
        mounts = {mount["name"]: mount["mountPath"] for mount in self.server["volumeMounts"]}
        self.assertTrue(found["data"]["dir"].startswith(mounts["data"] + "/"), "must be a subfolder of the volume")
        self.assertEqual(found["server"]["listen"].split(":")[1], str(self.server["ports"][0]["containerPort"]))
        report(f"deploy/kubernetes: `whereabouts config` accepts its {len(settings) + len(given)} settings")

    def test_probes_use_paths_that_need_no_key(self):
        check_probes(self, self.server)
        for path in ("/livez", "/readyz"):
            traffic.expect(traffic.ask("GET", path, role=None), 200)
        report("deploy/kubernetes: /livez and /readyz answer the probes without a key")

    def test_secrets_are_referenced_not_inlined(self):
        self.assertNotIn("Secret", self.by_kind)
        self.assertNotIn("kind: Secret", read("deploy/kubernetes/maintenance.yaml"))


if __name__ == "__main__":
    unittest.main()
