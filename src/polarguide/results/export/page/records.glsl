// Reading a Gaussian's record; its texels are listed in records.py.
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D records;

uvec4 texel(int gaussian, int index) {
  int at = gaussian * TEXELS + index;
  return texelFetch(records, ivec2(at & 4095, at >> 12), 0);
}

vec3 meanOf(uvec4 first) { return uintBitsToFloat(first.xyz); }
