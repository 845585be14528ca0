"use strict";
// Lengths are in units of half the scene's diagonal, colours linear until the last line.
const COMMON = `#version 300 es
precision highp float; precision highp int; precision highp sampler3D;
uniform sampler3D u_value;
uniform vec3 u_dims, u_origin, u_eye, u_forward, u_gain, u_albedo;
uniform mat3 u_inverse;
uniform vec4 u_clip;
uniform vec2 u_depth;
uniform float u_iso, u_scale;
uniform bool u_local, u_clipped, u_outside_lower;
float value(vec3 p) { return texture(u_value, (p + 0.5) / u_dims).r; }

// A cell that touches a sample that is not finite holds no surface.
bool hole(vec3 p) {
  ivec3 cell = clamp(ivec3(floor(p)), ivec3(0), ivec3(u_dims) - 2);
  for (int i = 0; i < 8; ++i)
    if (texelFetch(u_value, cell + ivec3(i & 1, i >> 1 & 1, i >> 2), 0).r > 5e4) return true;
  return false;
}

bool cut(vec3 x) { return dot(u_clip.xyz, x) > u_clip.w; }
vec4 display(vec3 linear) {
  vec3 c = clamp(linear * u_gain, 0.0, 1.0);
  return vec4(mix(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, 12.92 * c, lessThanEqual(c, vec3(0.0031308))), 1.0);
}
float headlight(float cosine) { return 0.15 + 0.85 * abs(cosine); }
`;

// One triangle over the whole picture; its directions are linear in the picture's coordinates.
const VOLUME_VERTEX = `#version 300 es
uniform vec3 u_forward, u_right, u_up;
out vec3 v_direction;
void main() {
  vec2 p = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  v_direction = u_forward + u_right * p.x + u_up * p.y;
  gl_Position = vec4(p, 0.0, 1.0);
}`;

// Marches in index coordinates: half a voxel at a time where the isosurface may be, block by block elsewhere.
const VOLUME_FRAGMENT = COMMON + `
in vec3 v_direction;
out vec4 colour;
uniform sampler3D u_light, u_other, u_blocks, u_visible, u_other_visible;
uniform ivec3 u_block_count;
uniform int u_most_steps, u_luminaires;
uniform bool u_capped, u_both;
uniform mat3 u_axes;
uniform vec3 u_steps, u_corners[64], u_facing[8], u_power[8];
uniform vec2 u_ranges[8];
uniform float u_most;

// Central differences between the samples that normals come from.
vec3 rising(vec3 p) {
  vec3 far = u_dims - 1.0, g;
  for (int a = 0; a < 3; ++a) {
    vec3 e = vec3(0.0);
    e[a] = u_steps[a];
    vec3 high = min(p + e, far), low = max(p - e, vec3(0.0));
    if (hole(high)) high = p;
    if (hole(low)) low = p;
    g[a] = (value(high) - value(low)) / max(high[a] - low[a], 1e-3);
  }
  return normalize(transpose(u_inverse) * g + vec3(0.0, 0.0, 1e-20));
}

// Lambert's closed form for the part of a polygon above the horizon (luminaire.rs).
float edge(vec3 a, vec3 b, vec3 n) {
  vec3 c = cross(a, b);
  float sine = length(c);
  return sine > 0.0 ? atan(sine, dot(a, b)) * dot(n, c) / sine : 0.0;
}
float open(int l, vec3 x, vec3 n) {
  int begin = int(u_ranges[l].x), count = int(u_ranges[l].y);
  if (dot(x - u_corners[begin], u_facing[l]) <= 0.0) return 0.0;
  vec3 first = vec3(0.0), last = vec3(0.0);
  bool any = false;
  float sum = 0.0;
  for (int i = 0; i < count; ++i) {
    vec3 a = u_corners[begin + i] - x, b = u_corners[begin + (i + 1) % count] - x;
    float ha = dot(a, n), hb = dot(b, n);
    vec3 taken[2] = vec3[2](a, mix(a, b, ha / (ha - hb)));
    bool takes[2] = bool[2](ha >= 0.0, (ha >= 0.0) != (hb >= 0.0));
    for (int k = 0; k < 2; ++k) {
      if (!takes[k]) continue;
      if (any) sum += edge(last, taken[k], n); else first = taken[k];
      any = true;
      last = taken[k];
    }
  }
  if (any) sum += edge(last, first, n);
  return max(-0.5 * sum, 0.0);
}

vec3 shade(vec3 p, bool lower, vec3 direction) {
  bool outside = lower == u_outside_lower;
  bool stored = outside || u_both;
  if (!u_local && stored) {
    vec3 at = (p + 0.5) / u_dims;
    vec4 light = outside ? texture(u_light, at) : texture(u_other, at);
    // Points that hold nothing have weight 0.
    if (light.a <= 0.0) return vec3(0.0);
    vec3 shown = u_scale * light.rgb / light.a, direct = vec3(0.0);
    if (u_luminaires == 0) return shown;
    vec3 x = u_origin + u_axes * p, n = (lower ? -1.0 : 1.0) * rising(p);
    for (int l = 0; l < u_luminaires; ++l) direct += open(l, x, n) * u_power[l];
    vec3 visible = u_most * (outside ? texture(u_visible, at) : texture(u_other_visible, at)).rgb / light.a;
    return shown + u_albedo / 3.14159265 * visible * direct;
  }
  if (!u_local && !u_clipped) return vec3(0.0);
  return u_albedo * headlight(dot(rising(p), direction)) * (u_local ? 1.0 : 0.3);
}

void main() {
  vec3 direction = normalize(v_direction);
  vec3 o = u_inverse * (u_eye - u_origin), d = u_inverse * direction, far = u_dims - 1.0;
  d = mix(d, vec3(1e-9), lessThan(abs(d), vec3(1e-9)));
  vec3 inverse = 1.0 / d, a = -o * inverse, b = (far - o) * inverse;
  vec3 near3 = min(a, b), far3 = max(a, b);
  float t0 = max(max(near3.x, near3.y), max(near3.z, 0.0)), t1 = min(far3.x, min(far3.y, far3.z));
  bool faced = t0 > 0.0, leaves = true;
  if (u_clipped) {
    float s = dot(u_clip.xyz, direction), k = u_clip.w - dot(u_clip.xyz, u_eye);
    if (s > 0.0) { if (k / s < t1) { t1 = k / s; leaves = false; } }
    else if (s < 0.0) { if (k / s > t0) { t0 = k / s; faced = false; } }
    else if (k < 0.0) discard;
  }
  if (t0 >= t1) discard;
  vec3 length3 = abs(d);
  float stride = 0.5 / max(length3.x, max(length3.y, length3.z));
  float t = t0, found = -1.0, leaves_block = t0;
  bool inside = value(o + d * t) >= u_iso, lower = true, empty = false;
  if (u_capped && inside && faced && !hole(o + d * (t + 1e-3 * stride))) discard; // a cap, drawn as a wall
  for (int i = 0; i < u_most_steps; ++i) {
    if (t >= leaves_block) {
      ivec3 block = clamp(ivec3((o + d * (t + 0.01 * stride)) / 8.0), ivec3(0), u_block_count - 1);
      vec2 range = texelFetch(u_blocks, block, 0).rg;
      vec3 leave = ((vec3(block) + vec3(greaterThan(d, vec3(0.0)))) * 8.0 - o) * inverse;
      empty = u_iso < range.x || u_iso > range.y;
      leaves_block = max(min(leave.x, min(leave.y, leave.z)), t) + 0.02 * stride;
    }
    float next = min(empty ? leaves_block : t + stride, t1);
    if ((value(o + d * next) >= u_iso) != inside) {
      float low = t, high = next;
      for (int k = 0; k < 9; ++k) {
        float middle = 0.5 * (low + high);
        if ((value(o + d * middle) >= u_iso) != inside) high = middle; else low = middle;
      }
      if (!hole(o + d * high) && !hole(o + d * low)) { found = high; lower = !inside; break; }
      inside = !inside;
    }
    if (next >= t1) break;
    t = next;
  }
  if (found >= 0.0) {
    colour = display(shade(clamp(o + d * found, vec3(0.0), far), lower, direction));
  } else if (u_capped && inside && leaves && !hole(o + d * (t1 - 1e-3 * stride))) {
    found = t1; // a cap from within, which holds no light
    vec3 normal = normalize(transpose(u_inverse) * vec3(equal(far3, vec3(t1))));
    colour = u_local ? display(u_albedo * headlight(dot(normal, direction))) : vec4(0.0, 0.0, 0.0, 1.0);
  } else discard;
  float z = found * dot(direction, u_forward);
  gl_FragDepth = clamp(0.5 * (u_depth.x + u_depth.y / z) + 0.5, 0.0, 1.0);
}`;

const FLAT_VERTEX = `#version 300 es
in vec3 a_position;
uniform vec3 u_eye, u_forward, u_right, u_up;
uniform vec2 u_depth;
out vec3 v_position;
void main() {
  vec3 x = a_position - u_eye;
  float z = dot(x, u_forward);
  v_position = a_position;
  gl_Position = vec4(dot(x, u_right) / dot(u_right, u_right), dot(x, u_up) / dot(u_up, u_up), u_depth.x * z + u_depth.y, z);
}`;

const FLAT_FRAGMENT = COMMON + `
in vec3 v_position;
out vec4 colour;
uniform sampler3D u_wall, u_wall_within;
uniform vec3 u_normal, u_corner, u_du, u_dv, u_emission;
uniform float u_place;
uniform bool u_cap, u_textured, u_opaque_back, u_within, u_outside_only;

// Texel-centred trilinear lookup, continued linearly over the outer half texels.
vec3 wall(sampler3D light, vec3 uvc) {
  ivec3 n = textureSize(light, 0);
  vec3 x = clamp(uvc, 0.0, 1.0) * vec3(n) - 0.5;
  ivec3 base = clamp(ivec3(max(x, vec3(0.0))), ivec3(0), max(n - 2, ivec3(0)));
  vec3 w = mix(x - vec3(base), vec3(0.0), equal(n, ivec3(1))), sum = vec3(0.0);
  for (int i = 0; i < 8; ++i) {
    ivec3 bit = ivec3(i & 1, i >> 1 & 1, i >> 2);
    vec3 f = mix(1.0 - w, w, equal(bit, ivec3(1)));
    sum += f.x * f.y * f.z * texelFetch(light, min(base + bit, n - 1), 0).rgb;
  }
  return u_scale * max(sum, vec3(0.0));
}

// Whether a solid of the isosurface holds p.
bool solid(vec3 p) {
  vec3 far = u_dims - 1.0, within = clamp(p, vec3(0.0), far);
  float above = (value(within) - u_iso) * (u_outside_lower ? 1.0 : -1.0);
  return all(lessThan(abs(p - within), vec3(1e-3))) && !hole(within) && above > 0.0;
}

void main() {
  vec3 direction = normalize(v_position - u_eye);
  float facing = dot(direction, u_normal);
  bool emits = any(greaterThan(u_emission, vec3(0.0)));
  if (u_cap) {
    vec3 p = u_inverse * (v_position - u_origin);
    p = clamp(p, vec3(0.0), u_dims - 1.0);
    if (facing > 0.0 || cut(v_position) || value(p) < u_iso || hole(p)) discard;
  } else if (facing > 0.0) {
    if (!u_opaque_back) discard; // walls are seen from inside only, what stands between from both by two polygons
    colour = vec4(0.0, 0.0, 0.0, 1.0);
    return;
  }
  if (u_local) {
    colour = display(emits ? vec3(1.0) : u_albedo * headlight(facing));
    return;
  }
  vec3 x = v_position - u_corner, light = u_emission, uvc = vec3(dot(u_du, x), dot(u_dv, x), u_place);
  bool within = !u_cap && solid(u_inverse * (v_position - u_origin));
  if (within && u_outside_only) light += u_clipped ? 0.3 * u_albedo * headlight(facing) : vec3(0.0);
  else if (u_textured) light += within && u_within ? wall(u_wall_within, uvc) : wall(u_wall, uvc);
  colour = display(light);
}`;
