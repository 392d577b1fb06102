# Start with `make demo` and `make test`.

CARGO ?= cargo
BINARY := target/release/whereabouts

.PHONY: help demo build assets reader nasm openvino chromium test scale-out conformance console console-bench examples crash fuzz lint features advisories format bench load soak record-examples openapi package wheel clean

help: ## List the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 18

demo: build reader ## Set up, build, index a town, localize frames in it, refine, print a report
	$(BINARY) demo --out demo-out

build: assets nasm ## Set up and build target/release/whereabouts
	@command -v $(CARGO) >/dev/null || { echo "cargo is missing: install Rust 1.95 with rustup (https://rustup.rs), then run make again" >&2; exit 1; }
	$(CARGO) build --release --locked

assets: ## Download ONNX Runtime and the built-in model, pinned by version and hash
	deploy/setup/assets.sh assets

nasm:
	@deploy/setup/nasm.sh

reader: ## Also download the reader of scene text, PP-OCRv5, pinned by version and hash
	deploy/setup/assets.sh --reader assets

openvino: ## Also download ONNX Runtime with OpenVINO, faster on many x86-64 processors
	deploy/setup/assets.sh --openvino assets

wheel: build ## Build the Python wheel, with the binary, the model and the client, in target/wheels
	deploy/wheel/build.sh target/wheel-venv target/wheels

chromium:
	@deploy/setup/chromium.sh

# Most tests wait for a server: two at a time would leave a two-core machine half idle.
test: assets reader nasm chromium ## Set up, build and run every test
	RUST_TEST_THREADS=4 tests/postgres.sh target/postgres-venv tests/s3.sh target/s3-venv $(CARGO) test --release --locked --workspace
	tests/scale_out.sh $(CARGO) target/postgres-venv
	tests/optional.sh $(CARGO)
	tests/api/conformance.sh $(BINARY) target/api-venv
	tests/grpc/check.sh $(BINARY) target/grpc-venv
	tests/console/check.sh $(BINARY) target/console-venv
	tests/deploy/check.sh $(BINARY) target/deploy-venv
	tests/mllm/check.sh $(BINARY) target/mllm-venv
	tests/reading/check.sh $(BINARY) target/reading-venv
	examples/check.sh $(BINARY) target/examples-venv
	deploy/wheel/build.sh target/wheel-venv target/wheels
	tests/wheel/check.sh target/wheels target/wheel-test-venv

scale-out: assets nasm ## Run only the black-box tests of servers and workers on a shared database
	tests/scale_out.sh $(CARGO) target/postgres-venv

conformance: build ## Fuzz the API against its OpenAPI description with thousands of generated requests
	tests/api/conformance.sh $(BINARY) target/api-venv 150

console: build reader chromium ## Test the operator console in a browser
	tests/console/check.sh $(BINARY) target/console-venv

console-bench: build chromium ## Measure the first view of the console on a server with many jobs and images
	tests/console/first_view.sh $(BINARY) target/console-venv

examples: build ## Test the clients, curl examples and load tests against the service
	examples/check.sh $(BINARY) target/examples-venv

crash: assets nasm ## Kill the server at 200 random moments and check that nothing acknowledged is lost
	WHEREABOUTS_CRASH_ROUNDS=200 $(CARGO) test --release --locked --test crash kill:: -- --nocapture

fuzz: assets nasm ## Feed a million mutated inputs to every parser of untrusted data
	WHEREABOUTS_FUZZ_RUNS=120000 $(CARGO) test --release --locked --test fuzz -- --nocapture

lint: nasm ## Check formatting, spelling, lints, rustdoc, licences, and the build without optional features
	CARGO=$(CARGO) deploy/setup/lint.sh target/lint
	$(CARGO) fmt --check
	target/lint/bin/typos
	target/lint/bin/cargo-deny --locked check bans licenses sources
	$(CARGO) clippy --release --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --release --locked --workspace --no-deps
	$(MAKE) features

features: nasm ## Check that the service builds without its optional features
	$(CARGO) clippy --release --locked -p whereabouts --no-default-features -- -D warnings

advisories: ## Check dependencies for known vulnerabilities; fetches the RustSec database
	CARGO=$(CARGO) deploy/setup/lint.sh target/lint
	target/lint/bin/cargo-deny --locked check advisories

format: ## Format the code
	$(CARGO) fmt

bench: build reader ## Run the benchmarks against their peers (downloads some gigabytes)
	PYTHON=$$(benches/peers/setup.sh) $(CARGO) bench --locked --bench preprocess --bench inference \
		--bench search --bench localize --bench refine --bench mllm --bench store --bench town --bench track --bench words --bench signs --bench reading

load: build ## Overload test: ten times the load the server can handle
	$(CARGO) bench --locked --bench overload

soak: build ## Soak test: mixed traffic for ten minutes, then check for growth
	$(CARGO) bench --locked --bench soak

record-examples: assets nasm ## Send the requests of docs/examples.json to a server and write its answers there
	WHEREABOUTS_RECORD_EXAMPLES=1 $(CARGO) test --release --locked --test blackbox -- documented

openapi: build ## Regenerate docs/openapi.json from the handlers and docs/examples.json
	$(BINARY) openapi > docs/openapi.json

package: build ## Pack the binary, its assets and the licences into target/whereabouts-VERSION-TARGET.tar.gz
	deploy/setup/package.sh $(BINARY) target

clean: ## Remove build output and downloads
	$(CARGO) clean
	rm -rf assets demo-out
