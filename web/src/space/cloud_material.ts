/** What the shaders of splats and of the volume share. */

import { CustomBlending, DataTexture, Matrix4, OneFactor, OneMinusSrcAlphaFactor, ShaderMaterial, Vector2, Vector4, type Texture } from "three";

import { paletteTexture } from "./palette";

export interface CloudUniforms {
  palette: { value: DataTexture };
  /** Which labels are shown. */
  shown: { value: DataTexture };
  /** Depths of what is no cloud. */
  occluders: { value: Texture | null };
  /** Size of the target, pixels. */
  view: { value: Vector2 };
  /** A point is left out where dot(cut.xyz, point) + cut.w < 0. */
  cut: { value: Vector4 };
  opacity: { value: number };
  threshold: { value: number };
  size: { value: number };
  /** From the screen to the scene. */
  toScene: { value: Matrix4 };
}

export function cloudUniforms(): CloudUniforms {
  return {
    palette: { value: paletteTexture() },
    shown: { value: paletteTexture() },
    occluders: { value: null },
    view: { value: new Vector2(1, 1) },
    cut: { value: new Vector4(0, 0, 0, 1) },
    opacity: { value: 1 },
    threshold: { value: 0 },
    size: { value: 1 },
    toScene: { value: new Matrix4() },
  };
}

/** Colours are multiplied by their opacity already. */
export function cloudMaterial(vertexShader: string, fragmentShader: string, uniforms: object): ShaderMaterial {
  return new ShaderMaterial({
    uniforms: uniforms as ShaderMaterial["uniforms"],
    vertexShader,
    fragmentShader,
    transparent: true,
    depthTest: false,
    depthWrite: false,
    blending: CustomBlending,
    blendSrc: OneFactor,
    blendDst: OneMinusSrcAlphaFactor,
  });
}
