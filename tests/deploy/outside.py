"""The external services: an MLLM that always gives the same answer, and two webhook receivers, one that accepts
every message and one that rejects every message.

    outside.py FILE

writes its URL to FILE, and runs until it is stopped.
"""

import json
import os
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

NOTES = "OBJECTS. A wall.\nMATCHES. The same wall (sure).\nCOMPARISON. Brick in both."
ANSWER = {
    "id": "1",
    "object": "chat.completion",
    "model": "scripted",
    "choices": [
        {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": NOTES}}
    ],
    "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110},
}


class Outside(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self):
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == "/v1/chat/completions":
            self.answer(200, json.dumps(ANSWER).encode())
        else:
            self.answer(200 if self.path == "/takes" else 500, b"{}")

    def answer(self, status, body):
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


if __name__ == "__main__":
    server = ThreadingHTTPServer(("127.0.0.1", 0), Outside)
    with open(sys.argv[1] + ".new", "w") as file:
        file.write(f"http://127.0.0.1:{server.server_port}")
    os.rename(sys.argv[1] + ".new", sys.argv[1])
    server.serve_forever()
