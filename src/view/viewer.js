const $ = (id) => document.getElementById(id);
const scene = JSON.parse($("description").textContent);
const canvas = $("view");
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((s, x, i) => s + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const clamp = (x, lo, hi) => Math.min(Math.max(x, lo), hi);
const EMPTY = 6e4; // the texture's value for samples that are not finite
const float = new Float32Array(1), integer = new Int32Array(float.buffer), f32 = Math.fround;
const bits = (x) => { float[0] = x; return integer[0]; };
/// Where isovalue c stands along an axis, bit for bit as isovalue_axis.rs has it.
function place({ even, from, slope, first, scale }, c) {
  c = clamp(f32(c), 0, 1);
  return f32(f32(even * c) + f32(scale * f32(bits(from + f32(slope * c)) - first)));
}
/// The isovalue that stands at a place of the volume's axis.
function isovalue(at) {
  if (scene.axis.scale === 0) return at;
  let lo = 0, hi = 1;
  for (let n = 0; n < 40; ++n) {
    const c = 0.5 * (lo + hi);
    if (place(scene.axis, c) < at) lo = c; else hi = c;
  }
  return 0.5 * (lo + hi);
}

/// What the user has chosen; lengths in half diagonals, angles in degrees.
const initial = () => ({
  iso: isovalue(0.5), shading: "global", azimuth: 0, elevation: 0, zoom: 1, shift: [0, 0, 0], exposure: 1, tint: [1, 1, 1],
  walls: true, clip: "", cut: 0.5,
});
let state = initial();
let gl, programs, textures = {}, flats = [], pending = false, quality = 1, busy = 0, cost = 0, settle = 0, timer = 0, size = null;

function fail(text) {
  for (const id of ["bar", "settings", "title", "help"]) $(id).hidden = true;
  $("message").textContent = text;
  $("message").hidden = false;
}

const toSource = (u) => scene.isovalues[0] + u * (scene.isovalues[1] - scene.isovalues[0]);
const toUnit = (v) => (v - scene.isovalues[0]) / (scene.isovalues[1] - scene.isovalues[0]);
/// Linear between stops [isovalue, colour], constant beyond, at the isovalue shown.
function albedo(stops) {
  const next = stops.findIndex(([c]) => c >= state.iso);
  if (next <= 0) return stops.at(next)[1];
  const [[c0, a], [c1, b]] = stops.slice(next - 1, next + 1);
  return add(a, add(b, a, -1), (state.iso - c0) / (c1 - c0));
}
/// Five digits of the sweep's width.
const precision = ([lo, hi]) => clamp(5 + Math.floor(Math.log10(Math.max(Math.abs(lo), Math.abs(hi)) / (hi - lo))), 5, 15);
const digits = (v) => String(Number(v.toPrecision(precision(scene.isovalues))));

async function unpack() {
  const packed = [...document.querySelectorAll("script.data")].map((part) => {
    const binary = atob(part.textContent), out = new Uint8Array(binary.length);
    part.remove();
    for (let i = 0; i < out.length; ++i) out[i] = binary.charCodeAt(i);
    return out;
  });
  const stream = new Blob(packed).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  if (bytes.length !== scene.length) throw new Error(`the data hold ${bytes.length} bytes instead of ${scene.length}`);
  return bytes;
}

/// The value of a 16-bit code: equal steps of the volume's axis over the sweep, geometric ones beyond.
function decode(code) {
  const octave = 512 / (32768 * Math.LN2), beyond = (n) => octave * (2 ** (n / 512) - 1);
  if (code === 0) return EMPTY;
  if (code < 16384) return Math.max(-beyond(16384 - code), -2e4);
  if (code > 49152) return Math.min(1 + beyond(code - 49152), 2e4);
  return isovalue((code - 16384) / 32768);
}

/// Rounded as 16-bit floats are.
function half(x) {
  const step = 2 ** Math.max(Math.floor(Math.log2(Math.abs(x))) - 10, -24);
  return Math.round(x / step) * step;
}

/// The isovalue shown as samples are stored: equal ones stay equal.
function stored() {
  const v = decode(16384 + Math.round(32768 * place(scene.axis, state.iso)));
  return textures.half ? half(v) : v;
}

function unpackValues(bytes, count) {
  const table = Float32Array.from({ length: 65536 }, (_, c) => decode(c)), out = new Float32Array(count);
  for (let i = 0, code = 0; i < count; ++i) {
    code = (code + (bytes[i] << 8) + bytes[count + i]) & 65535;
    out[i] = table[code];
  }
  return out;
}

/// Byte planes of differences to RGBA; without a fourth plane, A is 255.
function unpackColours(bytes, offset, count, planes) {
  const out = new Uint8Array(4 * count).fill(255);
  for (let p = 0; p < planes; ++p)
    for (let i = 0, v = 0, from = offset + p * count; i < count; ++i) out[4 * i + p] = v = (v + bytes[from + i]) & 255;
  return out;
}

/// Least and greatest sample of each block of 8 x 8 x 8 cells, faces included.
function blocks(values, [nx, ny, nz]) {
  const n = [nx, ny, nz].map((k) => Math.max(Math.ceil((k - 1) / 8), 1)), out = new Float32Array(2 * n[0] * n[1] * n[2]);
  for (let at = 0, z = 0; z < n[2]; ++z) for (let y = 0; y < n[1]; ++y) for (let x = 0; x < n[0]; ++x, at += 2) {
    let lo = Infinity, hi = -Infinity;
    for (let k = 8 * z; k <= Math.min(8 * z + 8, nz - 1); ++k) for (let j = 8 * y; j <= Math.min(8 * y + 8, ny - 1); ++j) {
      const row = (k * ny + j) * nx;
      for (let i = row + 8 * x, end = row + Math.min(8 * x + 8, nx - 1); i <= end; ++i) {
        const v = values[i];
        if (v < lo) lo = v;
        if (v > hi) hi = v;
      }
    }
    out[at] = lo;
    out[at + 1] = hi;
  }
  return { n, out };
}

function texture(dims, internal, format, type, data, filter) {
  const t = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_3D, t);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE]])
    gl.texParameteri(gl.TEXTURE_3D, key, value);
  gl.texImage3D(gl.TEXTURE_3D, 0, internal, ...dims, 0, format, type, data);
  return t;
}

function program(vertex, fragment) {
  const p = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const s = gl.createShader(kind);
    gl.shaderSource(s, source);
    gl.compileShader(s);
    if (!gl.getShaderParameter(s, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(s));
    gl.attachShader(p, s);
  }
  gl.bindAttribLocation(p, 0, "a_position");
  gl.linkProgram(p);
  if (!gl.getProgramParameter(p, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(p));
  const uniforms = {};
  for (let i = gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS) - 1; i >= 0; --i) {
    const { name, type } = gl.getActiveUniform(p, i), at = gl.getUniformLocation(p, name);
    uniforms[name] = {
      [gl.FLOAT]: (v) => gl.uniform1f(at, v), [gl.FLOAT_VEC2]: (v) => gl.uniform2fv(at, v),
      [gl.FLOAT_VEC3]: (v) => gl.uniform3fv(at, v), [gl.FLOAT_VEC4]: (v) => gl.uniform4fv(at, v),
      [gl.FLOAT_MAT3]: (v) => gl.uniformMatrix3fv(at, false, v), [gl.INT_VEC3]: (v) => gl.uniform3iv(at, v),
    }[type] ?? ((v) => gl.uniform1i(at, v));
  }
  const set = (values) => { for (const key in values) uniforms[key]?.(values[key]); };
  return { p, set };
}

function upload(bytes) {
  const { dims } = scene, count = dims[0] * dims[1] * dims[2], most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  if (Math.max(...dims) > most) throw new Error(`the volume is ${dims.join(" × ")}; this device holds ${most} along an axis`);
  // 32 bits if they can be interpolated, else 16.
  textures.half = !gl.getExtension("OES_texture_float_linear");
  const whole = unpackValues(bytes, count), values = textures.half ? whole.map(half) : whole, b = blocks(values, dims);
  textures.value = texture(dims, textures.half ? gl.R16F : gl.R32F, gl.RED, gl.FLOAT, values, gl.LINEAR);
  textures.blocks = texture(b.n, gl.RG32F, gl.RG, gl.FLOAT, b.out, gl.NEAREST);
  textures.count = b.n;
  const colours = (offset, size, planes, filter) => {
    const data = unpackColours(bytes, offset, size[0] * size[1] * size[2], planes);
    return texture(size, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, data, filter);
  };
  textures.lights = scene.lights.map((offset) => colours(offset, dims, 4, gl.LINEAR));
  textures.visible = scene.split.visible.map((offset) => colours(offset, dims, 3, gl.LINEAR));
  const none = texture([1, 1, 1], gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4), gl.NEAREST);
  flats = scene.flats.map((f) => {
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(f.vertices.flat()), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    const [wall, wallWithin] = [f.texture, f.within].map((t) => t ? colours(t.offset, t.dims, 3, gl.NEAREST) : none);
    return { ...f, vertex_array: vertices, count: f.vertices.length, wall, wallWithin };
  });
  if (!textures.visible.length) textures.visible.push(none);
  textures.empty = gl.createVertexArray();
  programs = { volume: program(VOLUME_VERTEX, VOLUME_FRAGMENT), flat: program(FLAT_VERTEX, FLAT_FRAGMENT) };
  const error = gl.getError();
  if (error) throw new Error(`WebGL error ${error} (out of graphics memory?)`);
}

/// Eye, its distance from what it turns around, and basis; `right` and `up` reach from the picture's centre to its edges
/// at distance 1.
function camera(width, height) {
  const [lo, hi] = scene.bounds, home = scene.camera.eye, pivot = add([0, 0, 0], state.shift);
  const a = state.azimuth * Math.PI / 180, e = state.elevation * Math.PI / 180;
  const forward = [Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), -Math.sin(e)];
  const x = unit(cross(forward, [0, 0, 1])), y = cross(x, forward);
  // The front face stays in narrow windows too: the eye steps back from it.
  const aspect = width / height, fit = Math.max(1, (hi[0] - lo[0]) / (hi[2] - lo[2]) / aspect - 1e-3);
  const front = 0.5 * (hi[1] - lo[1]), distance = (front + fit * (-home[1] - front)) / state.zoom;
  const tangent = Math.tan(scene.camera.fov * Math.PI / 360);
  // The box lies within 1 of the origin, wherever the pivot is.
  const depth = distance - dot(pivot, forward), near = Math.max(0.01, depth - 1.01), far = Math.max(depth, near) + 1.01;
  return {
    distance,
    u_eye: add(pivot, forward, -distance), u_forward: forward, u_right: x.map((v) => v * tangent * aspect),
    u_up: y.map((v) => v * tangent), u_depth: [(far + near) / (far - near), -2 * far * near / (far - near)],
  };
}

function clipPlane() {
  if (!state.clip) return [0, 0, 0, 1];
  const axis = "xyz".indexOf(state.clip.at(-1)), sign = state.clip.length > 1 ? -1 : 1, n = [0, 0, 0];
  n[axis] = sign;
  const [lo, hi] = scene.bounds;
  return [...n, sign * (lo[axis] + state.cut * (hi[axis] - lo[axis]))];
}

/// What direct light of a split bake is computed from.
function direct() {
  const { luminaires, most, steps } = scene.split, ranges = [];
  luminaires.reduce((begin, { corners }) => { ranges.push(begin, corners.length); return begin + corners.length; }, 0);
  const all = (key) => luminaires.flatMap((l) => l[key]).flat(), lists = luminaires.length ? {
    "u_corners[0]": all("corners"), "u_facing[0]": all("normal"), "u_power[0]": all("power"), "u_ranges[0]": ranges,
  } : {};
  return { u_luminaires: luminaires.length, u_most: most, u_steps: steps, u_axes: scene.axes.flat(), ...lists };
}

function draw() {
  pending = false;
  if (!programs) return;
  const interacting = performance.now() < settle, scale = interacting && !size ? quality : 1;
  const [width, height] = size ?? [canvas.clientWidth, canvas.clientHeight].map((n) =>
    Math.max(1, Math.round(n * scale * Math.min(devicePixelRatio, 2))));
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  gl.viewport(0, 0, width, height);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  gl.clearColor(0, 0, 0, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const common = {
    ...camera(width, height), u_value: 0, u_dims: scene.dims, u_inverse: scene.inverse, u_origin: scene.origin,
    u_iso: stored(), u_clip: clipPlane(), u_clipped: state.clip ? 1 : 0, u_local: state.shading === "local" ? 1 : 0,
    u_gain: state.tint.map((t) => t * state.exposure), u_scale: scene.scale,
    u_outside_lower: scene.outside_lower ? 1 : 0,
  };
  const bind = (unit, t) => { gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_3D, t); };
  bind(0, textures.value);
  gl.useProgram(programs.flat.p);
  programs.flat.set({ ...common, u_wall: 1, u_wall_within: 2 });
  for (const f of flats) {
    if (!f.cap && !state.walls) continue;
    bind(1, f.wall);
    bind(2, f.wallWithin);
    programs.flat.set({
      u_normal: f.normal, u_albedo: albedo(f.albedo), u_emission: f.emission, u_corner: f.corner, u_du: f.du, u_dv: f.dv,
      u_cap: f.cap ? 1 : 0, u_textured: f.texture ? 1 : 0, u_opaque_back: f.opaqueBack ? 1 : 0,
      u_within: f.within ? 1 : 0, u_outside_only: f.outsideOnly ? 1 : 0,
      u_place: f.texture ? place(f.texture.axis, state.iso) : 0,
    });
    gl.bindVertexArray(f.vertex_array);
    gl.drawArrays(gl.TRIANGLE_FAN, 0, f.count);
  }
  gl.useProgram(programs.volume.p);
  gl.bindVertexArray(textures.empty);
  bind(1, textures.lights[0]);
  bind(2, textures.lights.at(-1));
  bind(3, textures.blocks);
  bind(4, textures.visible[0]);
  bind(5, textures.visible.at(-1));
  programs.volume.set({
    ...common, u_light: 1, u_other: 2, u_blocks: 3, u_block_count: textures.count, u_albedo: albedo(scene.albedo),
    u_most_steps: 2 * (scene.dims[0] + scene.dims[1] + scene.dims[2]) + 64, u_capped: scene.capped ? 1 : 0,
    u_both: textures.lights.length > 1 ? 1 : 0, u_visible: 4, u_other_visible: 5, ...direct(),
  });
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

/// Coarser pictures while the user drags on a slow device; the full one as soon as nothing moves.
function frame(now) {
  if (now < settle) {
    if (busy++ > 1) quality = clamp(quality * (cost > 70 ? 0.75 : cost < 25 ? 1.15 : 1), 0.2, 1);
    clearTimeout(timer);
    timer = setTimeout(invalidate, Math.max(settle - performance.now(), 0) + 1);
  } else busy = 0;
  draw();
  // Not the time until the next one: that is the user's.
  requestAnimationFrame((then) => { cost = then - now; });
}

function invalidate() {
  if (pending) return;
  pending = true;
  requestAnimationFrame(frame);
}

function moved() {
  settle = performance.now() + 250;
  invalidate();
}

function histogram() {
  const c = $("histogram"), ratio = Math.min(devicePixelRatio, 2), context = c.getContext("2d");
  [c.width, c.height] = [Math.max(c.clientWidth * ratio, 1), Math.max(c.clientHeight * ratio, 1)];
  const bins = scene.histogram, most = Math.log1p(bins.reduce((a, b) => Math.max(a, b), 1)), w = c.width / bins.length;
  context.fillStyle = "#667";
  bins.forEach((n, i) => {
    const h = Math.log1p(n) / most * c.height;
    context.fillRect(i * w, c.height - h, Math.ceil(w), h);
  });
  context.fillStyle = "#d9a441";
  context.fillRect(place(scene.axis, state.iso) * c.width - ratio, 0, 2 * ratio, c.height);
}

const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const encoded = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
const fromHex = (text) => [0, 2, 4].map((i) => linear(parseInt(text.slice(i, i + 2), 16) / 255));
const toHex = (rgb) => "#" + rgb.map((v) => Math.round(255 * encoded(v)).toString(16).padStart(2, "0")).join("");

/// Brings the controls in line with the state, and draws.
function show() {
  state.iso = clamp(state.iso, 0, 1);
  state.elevation = clamp(state.elevation, -89, 89);
  state.zoom = clamp(state.zoom, 0.1, 50);
  $("isovalue").value = place(scene.axis, state.iso);
  $("isovalue").setAttribute("aria-valuetext", digits(toSource(state.iso)));
  if (document.activeElement !== $("number")) $("number").value = digits(toSource(state.iso));
  $("shading").value = state.shading;
  $("exposure").value = Math.log2(state.exposure);
  $("tint").value = toHex(state.tint);
  $("clip").value = state.clip;
  $("cut").value = state.cut;
  $("cut").hidden = !state.clip;
  $("walls").checked = state.walls;
  histogram();
  moved();
}

/// The state behind the page's name: #isovalue=80&shading=local …
function fromAddress() {
  // A + is one, as in 1e+6.
  for (const [key, value] of new URLSearchParams(location.hash.slice(1).replaceAll("+", "%2B"))) {
    const number = Number(value);
    if (key === "isovalue" && value && Number.isFinite(number)) state.iso = toUnit(number);
    else if (key === "shading" && ["local", "global"].includes(value)) state.shading = value;
    else if (["azimuth", "elevation"].includes(key) && Number.isFinite(number)) state[key] = number;
    else if (key === "zoom" && number > 0) state.zoom = number;
    else if (key === "exposure" && number > 0) state.exposure = clamp(number, 0.25, 8);
    else if (key === "walls") state.walls = value !== "0";
    else if (key === "tint" && /^[0-9a-f]{6}$/i.test(value)) state.tint = fromHex(value);
    else if (key === "clip") {
      const [axis, at] = value.split(",");
      if (/^-?[xyz]$/.test(axis)) [state.clip, state.cut] = [axis, clamp(Number(at ?? 0.5) || 0, 0, 1)];
    }
  }
}

/// Moves the isovalue along the volume's axis.
function move(step) {
  state.iso = isovalue(clamp(place(scene.axis, state.iso) + step, 0, 1));
}

function reset() {
  state = initial();
  fromAddress();
  show();
}

function controls() {
  const on = (id, event, action) => $(id).addEventListener(event, (e) => { action(e.target); show(); });
  on("isovalue", "input", (t) => { state.iso = isovalue(Number(t.value)); });
  on("number", "input", (t) => { if (t.value !== "") state.iso = toUnit(Number(t.value)); });
  $("number").addEventListener("blur", (e) => { e.target.value = digits(toSource(state.iso)); });
  $("number").addEventListener("keydown", (e) => {
    const step = { ArrowUp: 0.005, ArrowDown: -0.005 }[e.key];
    if (!step) return;
    e.preventDefault();
    move(step);
    show();
    e.target.value = digits(toSource(state.iso));
  });
  on("shading", "change", (t) => { state.shading = t.value; });
  on("exposure", "input", (t) => { state.exposure = 2 ** Number(t.value); });
  on("tint", "input", (t) => { state.tint = fromHex(t.value.slice(1)); });
  on("clip", "change", (t) => { state.clip = t.value; });
  on("cut", "input", (t) => { state.cut = Number(t.value); });
  on("walls", "change", (t) => { state.walls = t.checked; });
  $("reset").addEventListener("click", reset);
  $("keys").addEventListener("click", () => { $("help").hidden = !$("help").hidden; });
  const pick = (e) => {
    const box = $("histogram").getBoundingClientRect();
    state.iso = isovalue(clamp((e.clientX - box.left) / box.width, 0, 1));
    show();
  };
  $("histogram").addEventListener("pointerdown", (e) => {
    if (e.button) return;
    document.activeElement?.blur();
    e.target.setPointerCapture(e.pointerId);
    pick(e);
  });
  $("histogram").addEventListener("pointermove", (e) => { if (e.target.hasPointerCapture(e.pointerId)) pick(e); });
  $("help").addEventListener("click", (e) => { e.currentTarget.hidden = true; });

  const fingers = new Map();
  const pan = (dx, dy) => {
    const c = camera(canvas.clientWidth, canvas.clientHeight);
    state.shift = add(state.shift, c.u_right, -2 * dx / canvas.clientWidth * c.distance);
    state.shift = add(state.shift, c.u_up, 2 * dy / canvas.clientHeight * c.distance);
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    canvas.focus({ preventScroll: true });
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("pointermove", (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const now = [e.clientX, e.clientY], [dx, dy] = add(now, before, -1);
    if (fingers.size === 1) {
      if (e.shiftKey || e.buttons & 6) pan(dx, dy);
      else {
        state.azimuth += 0.35 * dx;
        state.elevation += 0.35 * dy;
      }
    } else {
      const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
      state.zoom *= Math.hypot(...add(now, other, -1)) / Math.max(Math.hypot(...add(before, other, -1)), 1);
      pan(0.5 * dx, 0.5 * dy);
    }
    fingers.set(e.pointerId, now);
    show();
  });
  for (const event of ["pointerup", "pointercancel"]) canvas.addEventListener(event, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    state.zoom *= Math.exp(-clamp(e.deltaY * (e.deltaMode ? 30 : 1), -200, 200) * 0.0015);
    show();
  }, { passive: false });

  const keys = {
    ArrowLeft: () => { state.azimuth -= 5; }, ArrowRight: () => { state.azimuth += 5; },
    ArrowUp: () => { state.elevation -= 5; }, ArrowDown: () => { state.elevation += 5; },
    "+": () => { state.zoom *= 1.1; }, "=": () => { state.zoom *= 1.1; }, "-": () => { state.zoom /= 1.1; },
    "[": () => move(-0.005), "]": () => move(0.005), "{": () => move(-0.05), "}": () => move(0.05),
    g: () => { state.shading = state.shading === "local" ? "global" : "local"; },
    w: () => { state.walls = !state.walls; },
    c: () => { const all = ["", "x", "y", "z", "-x", "-y", "-z"]; state.clip = all[(all.indexOf(state.clip) + 1) % 7]; },
    r: reset, h: () => { $("help").hidden = !$("help").hidden; }, "?": () => keys.h(), Escape: () => { $("help").hidden = true; },
  };
  addEventListener("keydown", (e) => {
    const typing = e.target.matches?.("input[type=number], select");
    const sliding = e.target.matches?.("input[type=range]") && e.key.startsWith("Arrow");
    // Capitals are small letters; some keyboards have brackets behind alt only.
    const key = keys[e.key] ? e.key : e.key.toLowerCase();
    if (!keys[key] || e.ctrlKey || (e.altKey && !"[]{}".includes(key)) || e.metaKey || typing || sliding) return;
    e.preventDefault();
    keys[key]();
    show();
  });
  addEventListener("resize", show);
  addEventListener("hashchange", reset);
  canvas.addEventListener("webglcontextlost", (e) => {
    e.preventDefault();
    programs = null;
    fail("The graphics driver took the picture away. Reload the page.");
  });
  canvas.addEventListener("webglcontextrestored", () => location.reload());
}

/// For scripts in the console: await isolume.ready; isolume.set({iso: 0.3}); isolume.pixels(640, 480); isolume.time(20).
const isolume = {
  scene,
  get state() { return state; },
  set(values) { Object.assign(state, values); show(); },
  /// The picture at a size of its own, RGBA rows from bottom to top.
  pixels(width, height) {
    size = [width, height];
    draw();
    const out = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, out);
    size = null;
    invalidate();
    return out;
  },
  /// Milliseconds per frame, mean of `n` at the given size.
  time(n, width = canvas.width, height = canvas.height) {
    this.pixels(width, height);
    const begun = performance.now();
    for (let i = 0; i < n; ++i) this.pixels(width, height);
    return (performance.now() - begun) / n;
  },
};
window.isolume = isolume;

isolume.ready = (async () => {
  if (scene.title) document.title = `${scene.title} – isolume`;
  $("title").textContent = scene.title;
  gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  if (!gl) throw new Error("This page needs WebGL2, which this browser or its graphics driver does not offer. " +
    "Any browser of the last years has it; check that hardware acceleration is on.");
  if (!window.DecompressionStream) throw new Error("This page needs DecompressionStream, which this browser is too old for.");
  upload(await unpack());
  $("facts").textContent = `${scene.dims.join(" × ")} points, isovalues ${digits(scene.isovalues[0])} to ` +
    `${digits(scene.isovalues[1])}. Made by isolume.`;
  for (const id of ["bar", "settings"]) $(id).hidden = false;
  $("title").hidden = !scene.title;
  $("message").hidden = true;
  controls();
  reset();
})();
isolume.ready.catch((e) => {
  fail(e.message);
  console.error(e);
});
