// The learned environment: faces with a ring of the neighbors' texels, so that four taps are seamless; see cubemap.py.
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D light;     // texels in a row: levels, faces, rows, columns, groups of four channels
uniform sampler2D viridis;   // 256 x 1
uniform int resolution;      // of the finest level
uniform int levels;

vec4 tap(int index) { return texelFetch(light, ivec2(index & 4095, index >> 12), 0); }

// Four channels of group `group` of `groups` on the level with n texels a side that begins at texel `first`.
vec4 lookUp(int first, int n, int groups, int group, vec3 d) {
  vec3 a = abs(d);
  int axis = a.x >= a.y && a.x >= a.z ? 0 : a.y >= a.z ? 1 : 2;
  float major = axis == 0 ? d.x : axis == 1 ? d.y : d.z;
  vec2 st = axis == 0 ? vec2(major < 0.0 ? d.z : -d.z, -d.y)
          : axis == 1 ? vec2(d.x, major < 0.0 ? -d.z : d.z)
                      : vec2(major < 0.0 ? -d.x : d.x, -d.y);
  int face = 2 * axis + (major < 0.0 ? 1 : 0);
  st = abs(major) > 1e-20 ? st / abs(major) : vec2(0.0);
  vec2 uv = (st + 1.0) * (0.5 * float(n)) + 0.5;
  ivec2 cell = ivec2(clamp(floor(uv), vec2(0.0), vec2(float(n))));
  vec2 f = uv - vec2(cell);
  int at = first + ((face * (n + 2) + cell.y) * (n + 2) + cell.x) * groups + group, down = (n + 2) * groups;
  return mix(mix(tap(at), tap(at + groups), f.x), mix(tap(at + down), tap(at + down + groups), f.x), f.y);
}
