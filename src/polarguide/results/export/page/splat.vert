// EWA projection of a Gaussian (Zwicker et al. 2001) to the box around its ellipse; as the rasterizer of the program.
precision highp sampler2D;
uniform sampler2D derivedColor, derivedNormal, derivedFurther;
uniform mat3 rotation; // world to camera
uniform vec3 eye;
uniform vec4 lens;     // fx, fy, cx, cy in pixels
uniform vec2 size;
in uint gaussian;
flat out vec4 color;
flat out vec4 normal;
flat out vec4 further;
out vec2 place; // in standard deviations

const float BLUR = 0.1, MARGIN = 0.15, NEAR = 0.01;

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside: nothing is drawn
  int index = int(gaussian);
  ivec2 at = ivec2(index & 2047, index >> 11);
  color = texelFetch(derivedColor, at, 0);
  normal = texelFetch(derivedNormal, at, 0);
#if defined(LOCAL) || defined(DIRECTIONAL)
  further = texelFetch(derivedFurther, at, 0);
#else
  further = vec4(0.0);
#endif
  place = vec2(0.0);
  uvec4 t0 = texel(index, 0), t1 = texel(index, 1), t2 = texel(index, 2);
  float opacity = unpackUnorm2x16(t0.w).x;
  vec3 local = rotation * (meanOf(t0) - eye);
  if (local.z <= NEAR || opacity < 1.0 / 255.0) return;

  vec4 q = normalize(vec4(unpackSnorm2x16(t1.x), unpackSnorm2x16(t1.y)));
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 turned = mat3(
      1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
      2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
      2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  vec3 scales = exp(vec3(unpackHalf2x16(t1.z), unpackHalf2x16(t1.w).x));
  // Larger than the training's: its pixels' blur.
  float trained = exp(unpackHalf2x16(t2.w & 0xFFFEu).x), own = local.z / sqrt(lens.x * lens.y);
  scales = sqrt(scales * scales + BLUR * max(trained * trained - own * own, 0.0));
  mat3 half_ = rotation * turned;
  half_ = mat3(half_[0] * scales.x, half_[1] * scales.y, half_[2] * scales.z);

  vec2 slope = local.xy / local.z;
  vec2 low = -lens.zw / lens.xy - MARGIN * size / lens.xy, high = (size - lens.zw) / lens.xy + MARGIN * size / lens.xy;
  vec2 kept = clamp(slope, low, high), focal = lens.xy / local.z;
  vec3 columns = vec3(half_[0].z, half_[1].z, half_[2].z);
  vec3 rowX = focal.x * (vec3(half_[0].x, half_[1].x, half_[2].x) - kept.x * columns);
  vec3 rowY = focal.y * (vec3(half_[0].y, half_[1].y, half_[2].y) - kept.y * columns);
  float a = dot(rowX, rowX) + BLUR, b = dot(rowX, rowY), c = dot(rowY, rowY) + BLUR;

  float middle = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
  float wide = middle + spread, narrow = max(middle - spread, BLUR);
  vec2 along = abs(b) > 1e-9 * middle ? normalize(vec2(b, wide - a)) : (a >= c ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(255.0 * opacity));
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  place = reach * corner;
  vec2 pixel = lens.xy * slope + lens.zw + sqrt(wide) * place.x * along + sqrt(narrow) * place.y * vec2(-along.y, along.x);
  vec2 shown = 2.0 * pixel / size - 1.0;
  gl_Position = vec4(shown.x, -shown.y, 0.0, 1.0);
}
