// From the blended layers to the picture: deferred reflection per pixel, as shading/deferred.py and directional.py.
uniform sampler2D target0, target1, target2, target3, target4;
uniform mat3 rotation; // world to camera
uniform mat3 turn;     // of the environment, world to learned axes
uniform vec4 lens;
uniform vec2 size;
uniform int layer;     // 0 final, 1 diffuse, 2 specular, 3 base, 4 strength, 5 normal, 6 metalness, 7 roughness
uniform float split;   // left of this column stands the diffuse layer
uniform float gain;    // on the specular layer
uniform float gloss;   // on it where it is shown alone
uniform float exposure;
uniform mat3 color;    // from the camera's linear RGB to what is shown
uniform bool soft;     // compress highlights
uniform float index;   // refractive
out vec4 shown;

const float MAXIMUM_LOG = 5.0;

// The tone curve of capture/presentation.py.
const float KNEE = 0.5;
vec3 toneMapped(vec3 linear) {
  vec3 v = min(linear, 1e30); // infinity times 0 is not a number
  float largest = max(max(max(v.r, v.g), v.b), KNEE);
  float mapped = 1.0 - (1.0 - KNEE) * (1.0 - KNEE) / (largest + 1.0 - 2.0 * KNEE);
  return v * (mapped / largest);
}

vec3 encode(vec3 linear) {
  vec3 v = color * linear * exposure;
  if (soft) v = toneMapped(v);
  v = clamp(v, 0.0, 1.0);
  return mix(12.92 * v, 1.055 * pow(max(v, 0.0031308), vec3(1.0 / 2.4)) - 0.055, greaterThan(v, vec3(0.0031308)));
}

#ifdef DIRECTIONAL
uniform sampler2D network; // weights by input, then biases, four outputs a texel; three layers
vec4 weight(int at) { return texelFetch(network, ivec2(at & 4095, at >> 12), 0); }

vec3 radiance(vec3 direction, float roughness, vec4 feature) {
  float level = clamp(float(levels) * roughness, 0.0, float(levels - 1));
  int lower = min(int(level), levels - 2), first = 0, n = resolution;
  for (int k = 0; k < lower; ++k) {
    first += 6 * (n + 2) * (n + 2) * 4;
    n = max(n / 2, 1);
  }
  int second = first + 6 * (n + 2) * (n + 2) * 4, m = max(n / 2, 1);
  vec4 factors = feature * inversesqrt(max(dot(feature, feature), 1e-6));
  float values[80];
  for (int group = 0; group < 4; ++group) {
    vec4 found = mix(lookUp(first, n, 4, group, direction), lookUp(second, m, 4, group, direction), level - float(lower));
    for (int k = 0; k < 4; ++k) {
      values[4 * group + k] = found[k];
      for (int j = 0; j < 4; ++j) values[16 + 16 * group + 4 * k + j] = found[k] * factors[j];
    }
  }
  float hidden[WIDTH];
  for (int k = 0; k < WIDTH / 4; ++k) {
    vec4 sum = weight(80 * (WIDTH / 4) + k);
    for (int i = 0; i < 80; ++i) sum += values[i] * weight(i * (WIDTH / 4) + k);
    for (int j = 0; j < 4; ++j) hidden[4 * k + j] = max(sum[j], 0.0);
  }
  int at = 81 * (WIDTH / 4);
  vec4 last = weight(at + (WIDTH + 1) * (WIDTH / 4) + WIDTH);
  for (int k = 0; k < WIDTH / 4; ++k) {
    vec4 sum = weight(at + WIDTH * (WIDTH / 4) + k);
    for (int i = 0; i < WIDTH; ++i) sum += hidden[i] * weight(at + i * (WIDTH / 4) + k);
    for (int j = 0; j < 4; ++j)
      last += max(sum[j], 0.0) * weight(at + (WIDTH + 1) * (WIDTH / 4) + 4 * k + j);
  }
  return exp(min(last.rgb, MAXIMUM_LOG));
}
#endif

#ifdef FRESNEL
const float LEVELS_OF_ROUGHNESS = 4.0; // of shading/cubemap.py
uniform float mirror; // GGX's alpha of a roughness of 0

// Radiance from a direction, blurred by so many levels; as cubemap.py.
vec3 blurred(vec3 direction, float level) {
  if (levels == 1) return lookUp(0, resolution, 1, 0, direction).rgb;
  level = clamp(level, 0.0, float(levels - 1));
  int lower = min(int(level), levels - 2), first = 0, n = resolution;
  for (int k = 0; k < lower; ++k) {
    first += 6 * (n + 2) * (n + 2);
    n = max(n / 2, 1);
  }
  vec3 fine = lookUp(first, n, 1, 0, direction).rgb;
  vec3 coarse = lookUp(first + 6 * (n + 2) * (n + 2), max(n / 2, 1), 1, 0, direction).rgb;
  return mix(fine, coarse, level - float(lower));
}
#endif

#ifdef METAL
const float LEAST_METAL = 0.01; // of shading/metal.py

// (Rs + Rp) / 2 of a conductor by its reflectance at normal incidence; as optics/fresnel.py.
vec3 conductor(float cosine, vec3 reflectance) {
  vec3 r = clamp(reflectance, 0.1, 0.985), n = 2.1 - 1.9 * r;
  vec3 k2 = ((n + 1.0) * (n + 1.0) * r - (n - 1.0) * (n - 1.0)) / (1.0 - r);
  float c = clamp(cosine, 0.0, 1.0), sine2 = 1.0 - c * c;
  vec3 real = n * n - k2 - sine2, squared = sqrt(real * real + 4.0 * n * n * k2);
  vec3 larger = sqrt(0.5 * (squared + abs(real)));
  vec3 across = 2.0 * c * mix(n * sqrt(k2) / larger, larger, greaterThanEqual(real, vec3(0.0)));
  vec3 s = (squared + c * c - across) / (squared + c * c + across), x = c * c * squared + sine2 * sine2;
  return 0.5 * s * (1.0 + (x - across * sine2) / (x + across * sine2));
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 base = texelFetch(target0, at, 0);
  vec3 normal = texelFetch(target1, at, 0).xyz;
  float squared = dot(normal, normal);
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec3 ray = transpose(rotation) * normalize(vec3((pixel - lens.zw) / lens.xy, 1.0));
  vec3 diffuse = base.rgb, specular = vec3(0.0);
  float strength = 0.0, rough = 0.0;
#ifdef LIT
  vec3 facing = normal * inversesqrt(max(squared, 1e-6));
  vec3 direction = turn * (ray - 2.0 * dot(ray, facing) * facing);
  vec3 further = texelFetch(target2, at, 0).rgb;
  strength = further.x;
#ifdef DIRECTIONAL
  vec3 last = texelFetch(target3, at, 0).xyz;
  if (base.a > 0.05)
    specular = min(last.z / base.a, 1.0) * radiance(direction, further.x, vec4(further.yz, last.xy));
#else
#ifdef FRESNEL
  rough = min(further.z / max(base.a, 1e-6), 1.0);
  vec3 lit = blurred(direction, LEVELS_OF_ROUGHNESS * rough);
#else
  vec3 lit = 1.0 / (1.0 + exp(-lookUp(0, resolution, 1, 0, direction).rgb));
#endif
#ifdef LOCAL
  lit = max(lit + texelFetch(target3, at, 0).rgb, 0.0);
#endif
#ifdef FRESNEL
  float c = clamp(-dot(ray, facing), 0.0, 1.0), t = sqrt(index * index - 1.0 + c * c), p = index * index * c;
  float s2 = (c - t) / (c + t), p2 = (p - t) / (p + t);
  specular = strength * 0.5 * (s2 * s2 + p2 * p2) * lit;
#ifdef METAL
  float metal = further.y;
  if (metal > LEAST_METAL) specular += metal * conductor(c, texelFetch(target4, at, 0).rgb / metal) * lit;
#endif
#else
  specular = strength * lit;
  diffuse = (1.0 - strength) * base.rgb;
#endif
#endif
#endif
  specular *= gain;
  int which = pixel.x < split ? 1 : layer;
  vec3 seen = encode(which == 0 ? diffuse + specular : which == 1 ? diffuse : which == 2 ? gloss * specular : base.rgb);
  if (which == 4) seen = texelFetch(viridis, ivec2(int(clamp(strength, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
#ifdef METAL
  if (which == 6)
    seen = texelFetch(viridis, ivec2(int(clamp(further.y, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
#endif
#ifdef FRESNEL
  if (which == 7) { // as glTF has it
    float root = sqrt(mirror * exp2(LEVELS_OF_ROUGHNESS * rough));
    seen = texelFetch(viridis, ivec2(int(clamp(root, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
  }
#endif
  if (which == 5) {
    float size_ = sqrt(squared);
    seen = 0.5 * (size_ > 1e-8 ? rotation * normal * vec3(1.0, -1.0, -1.0) / size_ : vec3(0.0)) + 0.5;
  }
  shown = vec4(seen, 1.0);
}
