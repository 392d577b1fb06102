"""The refiner mllm with a real llama-server."""

import json
import os
import subprocess
import unittest
import urllib.request
from pathlib import Path

URL, BINARY = os.environ["URL"], os.environ["BINARY"]
SCRATCH = Path(os.environ["SCRATCH"])


def call(path, body=None):
    headers = {"Content-Type": "image/jpeg"} if body else {}
    with urllib.request.urlopen(urllib.request.Request(URL + path, body, headers), timeout=120) as answer:
        return json.load(answer)


class LlamaServer(unittest.TestCase):
    def test_the_check_finds_out_what_it_can_do(self):
        environment = os.environ | {"WHEREABOUTS_MLLM__BASE_URL": os.environ["LLAMA"]}
        ran = subprocess.run(
            [BINARY, "mllm", "check", "--json"], env=environment, capture_output=True, text=True, timeout=120
        )
        # Whether noise is a ranking is decided by chance, and with it the exit code.
        self.assertIn(ran.returncode, (0, 1), ran.stderr)
        [server] = json.loads(ran.stdout)["servers"]
        findings = {finding["what"]: finding for finding in server["findings"]}
        self.assertTrue(findings["two pictures"]["ok"], findings)
        self.assertIn("a ranking", findings)
        can = server["server"]["capabilities"]
        self.assertEqual((can["two_pictures"], can["answer_format"]), (True, "bounded_schema"), findings)
        self.assertEqual((can["context_tokens"], can["calls_at_once"]), (16384, 1), findings)
        self.assertIsNone(server["server"]["trouble"])

    def test_it_ranks_the_descriptions_of_another_server(self):
        [map] = [map["name"] for map in call("/maps")["maps"]]
        frame = min((SCRATCH / "town").rglob("*.jpg")).read_bytes()
        answer = call(f"/localize?map={map}&refine=wait", frame)
        job = call(answer["job"]["href"] + "?wait=60")
        self.assertIn(job["state"], ("succeeded", "degraded"), job)
        self.assertEqual(len(job["descriptions"]), len(job["ranking"]), job)
        # Noise may leave labels out or repeat them, but the server was reached and its answer read.
        self.assertRegex(job["error"] or "left out", "left out|no ranking twice", job)
        describing, ranking = call("/status")["model_servers"]
        self.assertFalse(ranking["suspended"], ranking)
        self.assertIsNone(ranking["trouble"], ranking)
        self.assertEqual(ranking["capabilities"]["answer_format"], "bounded_schema")
        self.assertNotEqual(describing["url"], ranking["url"])

    def test_it_reasons_before_it_ranks(self):
        labels = {"type": "string", "enum": ["A", "B"]}
        # The schema as the refiner sends it; the order of its bytes is a test of the refiner's.
        schema = {
            "type": "object",
            "properties": {"reasoning": {"type": "string"}, "ranking": {"type": "array", "items": labels}},
            "required": ["reasoning", "ranking"],
            "additionalProperties": False,
        }
        request = {
            "model": "tiny",
            "messages": [{"role": "user", "content": "rank"}],
            "max_tokens": 500,
            "response_format": {"type": "json_schema", "json_schema": {"name": "r", "schema": schema}},
        }
        body = json.dumps(request).encode()
        headers = {"Content-Type": "application/json"}
        url = os.environ["LLAMA"] + "/chat/completions"
        with urllib.request.urlopen(urllib.request.Request(url, body, headers), timeout=60) as answer:
            said = json.load(answer)["choices"][0]["message"]["content"]
        self.assertRegex(said.lstrip(), r'^\{\s*"reasoning"', said)


if __name__ == "__main__":
    unittest.main()
