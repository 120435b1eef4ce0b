"""How terrains look: a sky, a light, and a checkered material for the ground."""

import mujoco

MATERIAL = "terrain"


def add_look(spec: mujoco.MjSpec, *, repeat: float) -> None:
    """Add sky, light and the material `MATERIAL`.

    Args:
        spec: the scene's spec; its own sky stays if it has one.
        repeat: repetitions of the pattern (two tiles) per metre.
    """
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="terrain_sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.75, 0.82, 0.9],
            rgb2=[0.95, 0.97, 1.0],
            width=64,
            height=384,
        )
    spec.add_texture(
        name=MATERIAL,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.28, 0.32, 0.36],
        rgb2=[0.22, 0.25, 0.29],
        width=256,
        height=256,
    )
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = MATERIAL
    spec.add_material(name=MATERIAL, textures=textures, texuniform=True, texrepeat=[repeat, repeat])
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
