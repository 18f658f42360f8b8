// The sky behind all Gaussians, of scenes that have one.
const dome = {hidden: false};

async function loadDome() {
  const block = element('sky');
  if (!block) return;
  const file = new Blob([bytesOf(block.textContent)], {type: 'image/png'});
  const image = await createImageBitmap(file, {colorSpaceConversion: 'none', premultiplyAlpha: 'none'});
  dome.program = compiled('dome-vertex-shader', 'dome-fragment-shader');
  dome.uniforms = Object.fromEntries(['sky', 'toWorld', 'intrinsics', 'corner'].map((name) => [name, gl.getUniformLocation(dome.program, name)]));
  gl.activeTexture(gl.TEXTURE0 + DOME_UNIT);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR); // without a seam where columns begin again
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
}

function drawDome({rotation: r}, intrinsics, [left, bottom, , height]) {
  // Into a part of the framebuffer, as the Gaussians in front of it.
  if (!dome.program || dome.hidden) return;
  gl.useProgram(dome.program);
  gl.uniform1i(dome.uniforms.sky, DOME_UNIT);
  gl.uniformMatrix3fv(dome.uniforms.toWorld, false, r.flat()); // columns are the rows of the world-to-camera rotation
  gl.uniform4f(dome.uniforms.intrinsics, ...intrinsics);
  gl.uniform2f(dome.uniforms.corner, left, bottom + height);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  gl.useProgram(program);
}
