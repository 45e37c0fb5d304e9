/** An error whose message is shown to the user. */
class Unable extends Error {}

/** Renders a model: one splatting pass into float targets, one shading pass. */
class Renderer {
  constructor(canvas, scene, shaders, arrays) {
    this.canvas = canvas;
    this.scene = scene;
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
    if (!gl) throw new Unable("This browser does not support WebGL 2.");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float"))
      throw new Unable("This GPU cannot render to float textures.");
    this.gl = gl;
    this.further = ["local", "directional"].includes(scene.kind);
    this.targetCount = { plain: 2, reflection: 3, local: 4, directional: 4 }[scene.kind] + (scene.metal ? 1 : 0);
    if (gl.getParameter(gl.MAX_DRAW_BUFFERS) < this.targetCount)
      throw new Unable(`This GPU cannot render to ${this.targetCount} textures at once, which metals take.`);
    this.defines = `#define TEXELS ${scene.texels}\n#define WIDTH ${scene.width || 4}\n` +
      [scene.kind.toUpperCase(), scene.kind !== "plain" && "LIT", scene.blend === "fresnel" && "FRESNEL",
        scene.metal && "METAL"].filter(Boolean).map((name) => `#define ${name}\n`).join("");
    this.deriver = this.program(shaders.full, shaders.records + shaders.derive);
    this.splatter = this.program(shaders.records + shaders.splat_vert, shaders.splat_frag);
    this.shader = this.program(shaders.full, shaders.light + shaders.shade);
    this.tables = {
      records: this.table(arrays.records, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4),
      viridis: this.table(arrays.viridis, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, 3, 256),
    };
    if (arrays.light) this.tables.light = this.table(arrays.light, gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, 4);
    if (arrays.network) this.tables.network = this.table(arrays.network, gl.RGBA32F, gl.RGBA, gl.FLOAT, 4);
    const rows = Math.max(1, Math.ceil(scene.count / 2048));
    this.derived = this.targets(2048, rows, this.further ? 3 : 2);
    this.order = gl.createBuffer();
    this.corners = gl.createVertexArray();
    gl.bindVertexArray(this.corners);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    const place = gl.getAttribLocation(this.splatter.program, "gaussian");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.nothing = gl.createVertexArray();
    this.shown = 0;
    this.blended = null;
    this.derivedFor = null; // the camera position
    this.blendedFor = null; // the camera; other settings need only the shading pass
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\n${this.defines}${text}`);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  texture() {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** A flat array as a texture of `width` texels with `channels` channels per row. */
  table(values, internal, format, type, channels, width = 4096) {
    const gl = this.gl, texture = this.texture(), height = Math.max(1, Math.ceil(values.length / channels / width));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Unable("The model is too large for this GPU.");
    const whole = new values.constructor(width * height * channels);
    whole.set(values);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, whole);
    return texture;
  }

  targets(width, height, count) {
    const gl = this.gl, frame = gl.createFramebuffer(), textures = [];
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    for (let k = 0; k < count; ++k) {
      textures.push(this.texture());
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, textures[k], 0);
    }
    gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost())
      throw new Unable("This GPU cannot render to several float textures.");
    return { frame, textures, width, height };
  }

  use({ program, places }, textures, values) {
    const gl = this.gl;
    gl.useProgram(program);
    let unit = 0;
    for (const [name, texture] of Object.entries(textures)) {
      if (!places[name] || !texture) continue;
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(places[name], unit++);
    }
    for (const [name, [kind, value]] of Object.entries(values)) {
      if (!places[name]) continue;
      if (kind === "mat3") gl.uniformMatrix3fv(places[name], false, transposed(value));
      else if (kind === "1i") gl.uniform1i(places[name], value);
      else gl[`uniform${kind}v`](places[name], kind === "1f" ? [value] : value);
    }
  }

  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.shown = order.length;
    this.blendedFor = null;
  }

  /** Splat the layers for a camera of the picture's size. */
  splat(camera) {
    const wanted = JSON.stringify(camera);
    if (wanted === this.blendedFor) return;
    this.blendedFor = wanted;
    const gl = this.gl, { width, height } = camera, eye = scaled(apply(transposed(camera.rotation), camera.translation), -1);
    if (!this.blended || this.blended.width !== width || this.blended.height !== height) {
      if (this.blended) {
        this.blended.textures.forEach((texture) => gl.deleteTexture(texture));
        gl.deleteFramebuffer(this.blended.frame);
      }
      this.blended = this.targets(width, height, this.targetCount);
    }
    if (String(this.derivedFor) !== String(eye)) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.derived.frame);
      gl.viewport(0, 0, this.derived.width, this.derived.height);
      this.use(this.deriver, this.tables, { eye: ["3f", eye], count: ["1i", this.scene.count] });
      gl.bindVertexArray(this.nothing);
      gl.disable(gl.BLEND);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      this.derivedFor = eye;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.blended.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const [derivedColor, derivedNormal, derivedFurther] = this.derived.textures;
    this.use(this.splatter, { records: this.tables.records, derivedColor, derivedNormal, derivedFurther }, {
      ...this.lens(camera), eye: ["3f", eye],
    });
    gl.bindVertexArray(this.corners);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.shown);
    gl.disable(gl.BLEND);
  }

  lens(camera) {
    return {
      rotation: ["mat3", camera.rotation],
      lens: ["4f", [camera.fx, camera.fy, camera.cx, camera.cy]],
      size: ["2f", [camera.width, camera.height]],
    };
  }

  /** Shade the splatted layers into the canvas. */
  shade(camera, { layer, split, turn, gain, exposure, color }) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, camera.width, camera.height);
    const targets = Object.fromEntries(this.blended.textures.map((texture, k) => [`target${k}`, texture]));
    this.use(this.shader, { ...this.tables, ...targets }, {
      ...this.lens(camera),
      turn: ["mat3", turning(this.scene.up, -turn * Math.PI / 180)],
      layer: ["1i", layer], split: ["1f", split], gain: ["1f", gain], exposure: ["1f", exposure], color: ["mat3", color],
      index: ["1f", this.scene.index], resolution: ["1i", this.scene.resolution], levels: ["1i", this.scene.levels],
      mirror: ["1f", this.scene.mirror || 0], gloss: ["1f", this.scene.gloss],
      soft: ["1i", this.scene.toneCurve === "soft" ? 1 : 0],
    });
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Wait until the picture is rendered: reading a pixel waits, unlike finish(). */
  wait() {
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}
