/* Points and lines of a width in pixels, by WebGL 2. Matrices are column-major arrays of 16. */

const POINT_VERTEX = `#version 300 es
uniform mat4 u_matrix; uniform float u_size; uniform vec2 u_limits; uniform vec4 u_lift;
layout(location = 0) in vec3 a_position; layout(location = 1) in vec3 a_color;
out vec3 v_color;
void main() {
  gl_Position = u_matrix * vec4(a_position, 1.0);
  gl_PointSize = clamp(u_size / max(gl_Position.w, 1e-6), u_limits.x, u_limits.y);
  v_color = mix(a_color, u_lift.rgb, u_lift.a);
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 v_color; out vec4 color;
void main() {
  if (length(gl_PointCoord - 0.5) > 0.5) discard;
  color = vec4(v_color, 1.0);
}`;

// Each line is four corners of a strip around it, cut off where it passes behind the eye.
const LINE_VERTEX = `#version 300 es
uniform mat4 u_matrix; uniform vec2 u_viewport; uniform float u_width, u_near, u_faded; uniform int u_cut;
layout(location = 0) in vec3 a_start; layout(location = 1) in vec3 a_end; layout(location = 2) in vec4 a_color;
out vec4 v_color;
void main() {
  vec4 p = u_matrix * vec4(a_start, 1.0), q = u_matrix * vec4(a_end, 1.0);
  v_color = vec4(a_color.rgb, a_color.a * (gl_InstanceID < u_cut ? 1.0 : u_faded));
  if ((p.w < u_near && q.w < u_near) || v_color.a == 0.0) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (p.w < u_near) p = mix(p, q, (u_near - p.w) / (q.w - p.w));
  else if (q.w < u_near) q = mix(q, p, (u_near - q.w) / (p.w - q.w));
  vec2 along = (q.xy / q.w - p.xy / p.w) * u_viewport;
  along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  float end = gl_VertexID < 2 ? -1.0 : 1.0, side = float(gl_VertexID & 1) * 2.0 - 1.0;
  vec4 at = end < 0.0 ? p : q;
  vec2 offset = vec2(-along.y, along.x) * side + along * end * 0.5;
  gl_Position = vec4(at.xy + offset * u_width / u_viewport * at.w, at.zw);
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 v_color; out vec4 color;
void main() { color = v_color; }`;

/** What draws on a canvas; null where the browser has no WebGL 2. */
function createPainter(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) return null;
  const programs = { points: link(gl, POINT_VERTEX, POINT_FRAGMENT), lines: link(gl, LINE_VERTEX, LINE_FRAGMENT) };
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);

  function attribute(location, data, size, type, { stride = 0, offset = 0, divisor = 0 } = {}, buffer = null) {
    if (!buffer) {
      buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, type, type === gl.UNSIGNED_BYTE, stride, offset);
    gl.vertexAttribDivisor(location, divisor);
    return buffer;
  }

  function layer(kind, count, fill) {
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    const buffers = fill();
    gl.bindVertexArray(null);
    return { kind, count, vertices, buffers };
  }

  return {
    /** positions: 3 floats, colors: 3 bytes a point. */
    points: (positions, colors) =>
      layer("points", positions.length / 3, () => [
        attribute(0, positions, 3, gl.FLOAT),
        attribute(1, colors, 3, gl.UNSIGNED_BYTE),
      ]),
    /** ends: 6 floats, colors: 4 bytes a line. */
    lines: (ends, colors) =>
      layer("lines", ends.length / 6, () => {
        const buffer = attribute(0, ends, 3, gl.FLOAT, { stride: 24, divisor: 1 });
        attribute(1, null, 3, gl.FLOAT, { stride: 24, offset: 12, divisor: 1 }, buffer);
        return [buffer, attribute(2, colors, 4, gl.UNSIGNED_BYTE, { divisor: 1 })];
      }),
    remove(old) {
      if (!old) return;
      old.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
      gl.deleteVertexArray(old.vertices);
    },
    begin(background) {
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.depthMask(true);
      gl.clearColor(...background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    },
    /** How wide or large is said in pixels of the canvas. `cut`: lines from there on are drawn as faint as `faded`. */
    draw(drawn, { matrix, near, width = 1, cut = Infinity, faded = 1, size, limits, lift, above = false }) {
      if (!drawn || !drawn.count) return;
      const { program, at } = programs[drawn.kind];
      gl.useProgram(program);
      gl.uniformMatrix4fv(at.u_matrix, false, matrix);
      gl[above ? "disable" : "enable"](gl.DEPTH_TEST);
      gl.bindVertexArray(drawn.vertices);
      if (drawn.kind === "points") {
        gl.uniform1f(at.u_size, size);
        gl.uniform2f(at.u_limits, ...limits);
        gl.uniform4f(at.u_lift, ...lift);
        gl.drawArrays(gl.POINTS, 0, drawn.count);
      } else {
        gl.uniform2f(at.u_viewport, canvas.width, canvas.height);
        gl.uniform1f(at.u_width, width);
        gl.uniform1f(at.u_near, near);
        gl.uniform1f(at.u_faded, faded);
        gl.uniform1i(at.u_cut, Math.min(cut, drawn.count));
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, drawn.count);
      }
      gl.bindVertexArray(null);
    },
  };
}

/** A program and where its uniforms are. */
function link(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}
