# isolume is a plain cargo package; this file gets its two native libraries and names the common errands.

.PHONY: all deps demo gallery test check peers bench fuzz doc clean distclean

# `make deps` writes third_party/env.sh only if libclang had to be unpacked there.
CARGO = if [ -f third_party/env.sh ]; then . third_party/env.sh; fi; cargo

# The program that errands run: built here, unless ISOLUME names one.
PROGRAM = $(or $(ISOLUME),$${CARGO_TARGET_DIR:-target}/release/isolume)

all: deps
	$(if $(ISOLUME),,$(CARGO) build --release)

# Embree 4 and libclang: installed ones, or else fetched (see scripts/get-deps). EMBREE_DIR=... names your own Embree.
deps:
	@scripts/get-deps

# A first picture: bakes the bumps scene and renders one isosurface of it.
demo: all
	@mkdir -p demo
	$(PROGRAM) bake scenes/cornell-bumps.toml -o demo/bumps.vti --preset preview
	$(PROGRAM) render demo/bumps.vti --isovalue 47 -o demo/bumps.png
	@echo
	@echo "demo/bumps.vti  the volume with its illumination, for every isovalue: open it in ParaView, or render it again:"
	@echo "                cargo run --release -- render demo/bumps.vti --isovalue 60 -o demo/other.png"
	@echo "demo/bumps.png  the isosurface at 47"

# The paper's figures and more, into docs/gallery: some minutes. DATA=folder adds ch2.nii.gz (brain) and neuron.mha; QUALITY=full
# takes standard bakes and larger pictures instead of previews.
gallery: all
	scripts/gallery $(PROGRAM) docs/gallery --work demo/gallery $(if $(DATA),--data $(DATA)) $(if $(QUALITY),--$(QUALITY))

test: deps
	$(CARGO) test

# What a change must pass besides the tests.
check: deps
	cargo fmt --check
	$(CARGO) clippy --all-targets -- -D warnings
	export RUSTDOCFLAGS='-D warnings'; $(CARGO) doc --no-deps

# Every reader and writer against the tools people use (PyPI, pinned), the recipes, and radiance against Mitsuba 3. PEERS_DATA=folder adds its volumes.
PEERS = third_party/peers
peers: all $(PEERS)/installed
	$(PEERS)/bin/python scripts/peers/formats.py $(PROGRAM) $(PEERS_DATA)
	$(PEERS)/bin/python scripts/peers/recipes.py $(PROGRAM) docs/recipes.md
	$(PEERS)/bin/python scripts/peers/mitsuba3.py $(PROGRAM) $(PEERS)/mitsuba3

$(PEERS)/installed: scripts/peers/requirements.txt
	python3 -m venv $(PEERS)
	$(PEERS)/bin/pip install --quiet --requirement $<
	@touch $@

bench: deps
	$(CARGO) bench

# Every reader for FUZZ_SECONDS; needs the nightly toolchain and `cargo install cargo-fuzz`. Seeds: tests/corpus.
FUZZ_SECONDS = 60
FUZZ = cube:cube legacy_vtk:vtk metaimage:mha mrc:mrc nifti:nii npy:npy nrrd:nrrd raw:raw tiff:tif vti:vti

fuzz: deps
	@cargo fuzz --version >/dev/null 2>&1 || { echo "make fuzz: needs cargo install cargo-fuzz, and rustup toolchain install nightly"; exit 1; }
	@if [ -f third_party/env.sh ]; then . third_party/env.sh; fi; for target in $(FUZZ); do \
	  name=$${target%:*}; seeds=fuzz/corpus/$$name; mkdir -p $$seeds; \
	  find tests/corpus -size -16k \( -name "*.$${target#*:}" -o -name "*.$${target#*:}.*" \) -exec cp {} $$seeds/ \; ; \
	  cargo +nightly fuzz run $$name -- -max_total_time=$(FUZZ_SECONDS) -max_len=65536 -rss_limit_mb=1024 -timeout=60 || exit 1; \
	done

doc: deps
	$(CARGO) doc --no-deps

clean:
	cargo clean
	rm -rf demo

# Also what `make deps` fetched.
distclean: clean
	rm -rf third_party
