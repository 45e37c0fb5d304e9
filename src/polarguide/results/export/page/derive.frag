// One fragment per Gaussian: what depends on the eye but not on the pixel.
layout(location = 0) out vec4 color;  // base color or albedo; strength or roughness; of metals see splat.frag
layout(location = 1) out vec4 normal;  // world axes, toward the eye; opacity
#if defined(LOCAL) || defined(DIRECTIONAL)
layout(location = 2) out vec4 further; // light of its own, roughness; or features
#endif
uniform vec3 eye;
uniform int count;

const float GRAZING = 0.35;

float signedByte(uint words[12], int index) {
  return float(int(words[index >> 2] << (24 - 8 * (index & 3))) >> 24);
}

// Harmonics of degrees 1 to 3, as in gaussians/harmonics.py.
vec3 harmonics(int gaussian, int first, float scale, vec3 d) {
  uvec4 a = texel(gaussian, first), b = texel(gaussian, first + 1), c = texel(gaussian, first + 2);
  uint words[12] = uint[12](a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w);
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[15] = float[15](
      -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
      1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2.0 * zz - xx - yy),
      -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
      -0.5900435899266435 * y * (3.0 * xx - yy), 2.890611442640554 * x * y * z,
      -0.4570457994644658 * y * (4.0 * zz - xx - yy), 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
      -0.4570457994644658 * x * (4.0 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
      -0.5900435899266435 * x * (xx - 3.0 * yy));
  vec3 sum = vec3(0.0);
  for (int k = 0; k < 15; ++k)
    sum += basis[k] * vec3(signedByte(words, 3 * k), signedByte(words, 3 * k + 1), signedByte(words, 3 * k + 2));
  return scale * sum;
}

void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  int gaussian = place.y * 2048 + place.x;
  if (gaussian >= count) discard;
  uvec4 t0 = texel(gaussian, 0), t1 = texel(gaussian, 1), t2 = texel(gaussian, 2);
  vec2 shares = unpackUnorm2x16(t0.w);
  vec3 offset = meanOf(t0) - eye;
  float distance = length(offset);
  vec3 ray = distance > 1e-12 ? offset / distance : vec3(0.0);

  vec3 axis = vec3(unpackSnorm2x16(t2.y).y, unpackSnorm2x16(t2.z));
  float facing = -dot(offset, axis);
  bool outward = (t2.w & 1u) == 1u;
  if (outward && facing * facing < GRAZING * GRAZING * distance * distance) facing = 1.0;
  if (facing < 0.0) axis = -axis;

  vec3 direct = vec3(unpackHalf2x16(t2.x), unpackHalf2x16(t2.y).x);
  normal = vec4(axis, shares.x);
#ifdef DIRECTIONAL
  uvec4 t3 = texel(gaussian, 3);
  color = vec4(direct, shares.y);
  further = vec4(unpackSnorm2x16(t3.x), unpackSnorm2x16(t3.y));
#else
  vec3 base = 0.28209479177387814 * direct + harmonics(gaussian, 3, unpackHalf2x16(t1.w).y, ray) + 0.5;
  color = vec4(max(base, 0.0), shares.y);
#endif
#ifdef METAL
  uvec4 t10 = texel(gaussian, 10);
  vec3 metal = vec3(unpackHalf2x16(t10.x), unpackHalf2x16(t10.y).x);
  if (metal.r > 0.0) color = vec4(metal, -1.0);
#endif
#ifdef LOCAL
  uvec4 t6 = texel(gaussian, 6);
  vec3 mirrored = ray - 2.0 * dot(ray, axis) * axis;
  vec3 own = vec3(unpackHalf2x16(t6.x), unpackHalf2x16(t6.y).x);
  own = 0.28209479177387814 * own + harmonics(gaussian, 7, unpackHalf2x16(t6.y).y, mirrored);
  further = vec4(own, float(t2.w >> 16) / 65535.0);
#endif
}
