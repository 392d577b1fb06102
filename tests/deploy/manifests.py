"""The manifests as built by kustomize, and the checks shared by all of them."""

import shutil
import subprocess

import kubernetes_validate
import yaml
from compose import instructions
from files import DEPLOY, documents, report

FOLDER = DEPLOY / "kubernetes"
# The oldest version with ReadWriteOncePod generally available, and the newest with published schemas.
VERSIONS = ["1.29", "1.37"]


def built(overlay):
    """The overlay as built by kustomize, and the tool; without a tool, the files unchanged."""
    for tool in (["kubectl", "kustomize"], ["kustomize", "build"]):
        if shutil.which(tool[0]):
            ran = subprocess.run([*tool, FOLDER / overlay], capture_output=True, text=True, check=False)
            if ran.returncode:
                raise AssertionError(f"kustomize: {ran.stderr}")
            return list(yaml.safe_load_all(ran.stdout)), " ".join(tool)
    files = [file for part in ("base", overlay) for file in sorted((FOLDER / part).glob("*.yaml"))]
    files = [file for file in files if file.name != "kustomization.yaml"]
    return [one for file in files for one in yaml.safe_load_all(file.read_text())], None


def settings_of(overlay):
    """The name of the overlay's ConfigMap, and its content."""
    [file] = documents(f"deploy/kubernetes/{overlay}/kustomization.yaml")
    [made] = file["configMapGenerator"]
    return made["name"], dict(literal.split("=", 1) for literal in made["literals"])


def check_resources(case, overlay, resources, tool):
    """Fails if a resource is invalid, or if a file in the overlay's folder is not part of it."""
    for resource in resources:
        for version in VERSIONS:
            with case.subTest(resource["kind"], version=version):
                case.assertIsNone(fault(resource, version))
    for folder in ("base", overlay):
        [listed] = documents(f"deploy/kubernetes/{folder}/kustomization.yaml")
        files = {file.name for file in (FOLDER / folder).glob("*.yaml")} - {"kustomization.yaml"}
        case.assertEqual({name for name in listed["resources"] if name.endswith(".yaml")}, files, folder)
    how = f"built by `{tool}`" if tool else "not built, because kubectl is not installed"
    report(f"kubernetes/{overlay}: {len(resources)} resources, {how}, valid for {' and '.join(VERSIONS)}")


def fault(resource, version):
    """The validation error of a resource, if any."""
    try:
        kubernetes_validate.validate(resource, version, strict=True)
    except kubernetes_validate.ValidationError as error:
        return f"{resource['kind']}: {'.'.join(map(str, error.path))}: {error.message}"
    return None


def check_restricted(case, pod):
    """Fails if a pod violates the profile `restricted`, or has more privileges than ours need."""
    of_pod = pod["securityContext"]
    case.assertIs(of_pod["runAsNonRoot"], True)
    case.assertEqual(of_pod["seccompProfile"], {"type": "RuntimeDefault"})
    user = f"{of_pod['runAsUser']}:{of_pod['runAsGroup']}"
    case.assertEqual([user], instructions()["USER"])
    case.assertEqual(of_pod["fsGroup"], of_pod["runAsGroup"])
    case.assertIs(pod["automountServiceAccountToken"], False)
    # They would set variables such as WHEREABOUTS_PORT.
    case.assertIs(pod["enableServiceLinks"], False)
    for container in pod["containers"] + pod.get("initContainers", []):
        of_container = container["securityContext"]
        case.assertIs(of_container["allowPrivilegeEscalation"], False)
        case.assertIs(of_container["readOnlyRootFilesystem"], True)
        case.assertEqual(of_container["capabilities"], {"drop": ["ALL"]})
        case.assertLessEqual({"cpu", "memory"}, set(container["resources"]["limits"]))
        for variable in container.get("env", []):
            if "KEY" in variable["name"] or variable["name"].endswith("DATABASE__URL"):
                case.assertIn("secretKeyRef", variable["valueFrom"], "a secret must be referenced, not inlined")


def check_probes(case, container):
    """Fails if a probe uses a path that needs an API key."""
    for probe, path in (("livenessProbe", "/livez"), ("readinessProbe", "/readyz")):
        asked = container[probe]["httpGet"]
        case.assertEqual([asked["path"], asked["port"]], [path, container["ports"][0]["name"]])
