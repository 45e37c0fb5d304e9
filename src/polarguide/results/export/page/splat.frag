// Premultiplied values, blended back to front into every target alike.
precision highp float;
flat in vec4 color;
flat in vec4 normal;
flat in vec4 further;
in vec2 place;
layout(location = 0) out vec4 target0;
layout(location = 1) out vec4 target1;
#ifdef LIT
layout(location = 2) out vec4 target2;
#endif
#if defined(LOCAL) || defined(DIRECTIONAL)
layout(location = 3) out vec4 target3;
#endif
#ifdef METAL
layout(location = 4) out vec4 target4; // reflectance of metals
#endif

void main() {
  float alpha = min(0.99, normal.w * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  target0 = vec4(alpha * color.rgb, alpha);
  target1 = vec4(alpha * normal.xyz, alpha);
#if defined(DIRECTIONAL)
  target2 = vec4(alpha * vec3(color.a, further.xy), alpha);
  // Surroundings have no features, and no surface that reflects.
  float surface = dot(further, further) > 0.0 ? 1.0 : 0.0;
  target3 = vec4(alpha * vec3(further.zw, surface), alpha);
#elif defined(METAL)
  // A metal has no base color and no strength: its reflectance stands in place of the one, -1 of the other.
  bool metal = color.a < 0.0;
  if (metal) target0.rgb = vec3(0.0);
  target2 = vec4(alpha * (metal ? vec3(0.0, 1.0, further.a) : vec3(color.a, 0.0, further.a)), alpha);
  target3 = vec4(alpha * further.rgb, alpha);
  target4 = vec4(metal ? alpha * color.rgb : vec3(0.0), alpha);
#elif defined(LOCAL)
  target2 = vec4(alpha * vec3(color.a, 0.0, further.a), alpha);
  target3 = vec4(alpha * further.rgb, alpha);
#elif defined(LIT)
  target2 = vec4(alpha * color.a, 0.0, 0.0, alpha);
#endif
}
