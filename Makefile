# Two targets are all a newcomer needs: `make demo` and `make test`.

CARGO ?= cargo
BINARY := target/release/whereabouts

.PHONY: help demo build assets nasm openvino chromium test scale-out conformance console console-bench examples crash fuzz lint format bench load soak openapi clean

help: ## Say what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 15

demo: build ## Set up, build, index a town, localize in it, refine, print what happened
	$(BINARY) demo --out demo-out

build: assets nasm ## Set up and build target/release/whereabouts
	@command -v $(CARGO) >/dev/null || { echo "cargo is missing: install Rust 1.95 or later, then run make again" >&2; exit 1; }
	$(CARGO) build --release --locked

assets: ## Get ONNX Runtime and the built-in model, pinned by version and hash
	deploy/setup/assets.sh assets

nasm:
	@deploy/setup/nasm.sh

openvino: ## Get ONNX Runtime with OpenVINO too, the faster one on many x86-64 processors
	deploy/setup/assets.sh --openvino assets

chromium:
	@deploy/setup/chromium.sh

test: assets nasm chromium ## Set up, build and run every test
	tests/postgres.sh target/postgres-venv tests/s3.sh target/s3-venv $(CARGO) test --release --locked
	tests/scale_out.sh $(CARGO) target/postgres-venv
	tests/api/conformance.sh $(BINARY) target/api-venv
	tests/grpc/check.sh $(BINARY) target/grpc-venv
	tests/console/check.sh $(BINARY) target/console-venv
	tests/deploy/check.sh $(BINARY) target/deploy-venv
	examples/check.sh $(BINARY) target/examples-venv

scale-out: assets nasm ## Run only the black-box tests of servers and workers that share a database
	tests/scale_out.sh $(CARGO) target/postgres-venv

conformance: build ## Hold the server against its own description with thousands of made-up requests
	tests/api/conformance.sh $(BINARY) target/api-venv 150

console: build chromium ## Open the operator's console in a browser and use it
	tests/console/check.sh $(BINARY) target/console-venv

console-bench: build chromium ## Measure the first view of the console on a server with much to show
	tests/console/first_view.sh $(BINARY) target/console-venv

examples: build ## Check the clients, the calls in curl and the load tests against the service
	examples/check.sh $(BINARY) target/examples-venv

crash: assets nasm ## Kill the server at 200 random moments and hold it against what it acknowledged
	WHEREABOUTS_CRASH_ROUNDS=200 $(CARGO) test --release --locked --test crash what_was -- --nocapture

fuzz: assets nasm ## Run a million mutated inputs through everything that reads what others wrote
	WHEREABOUTS_FUZZ_RUNS=120000 $(CARGO) test --release --locked --test fuzz -- --nocapture

lint: ## Check the format and the lints
	$(CARGO) fmt --check
	$(CARGO) clippy --release --locked --all-targets -- -D warnings

format: ## Format the code
	$(CARGO) fmt

bench: build ## Measure all that is about speed, each against its peers; gets those, some gigabytes
	PYTHON=$$(benches/peers/setup.sh) $(CARGO) bench --locked --bench preprocess --bench inference \
		--bench search --bench localize --bench refine --bench mllm --bench store --bench town

load: build ## Offer ten times what the server can do, and check how it bears that
	$(CARGO) bench --locked --bench overload

soak: build ## Mixed traffic for ten minutes, then what has grown
	$(CARGO) bench --locked --bench soak

openapi: build ## Write docs/openapi.json anew from the handlers
	$(BINARY) openapi > docs/openapi.json

clean: ## Remove what was built and downloaded
	$(CARGO) clean
	rm -rf assets demo-out
