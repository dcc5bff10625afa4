"""Export of glass, dense content, cameras and sky as one package of Universal Scene Description (.usdz).

Source:
    Pixar, OpenUSD: UsdPreviewSurface 2.6 and UsdLuxDomeLight; MaterialX: Autodesk Standard Surface.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfro.core.cameras import Cameras
from nerfro.core.errors import optional
from nerfro.exports.meshes import attenuation
from nerfro.files.lat_long import save_lat_long
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.viewing.trained_scene import TrainedScene, absorption_of

if TYPE_CHECKING:
    import trimesh

_FILM_WIDTH = 0.24  # in tenths of a world unit, as the format states lengths of lenses
_OPACITY = 0.1  # of glass where light does not bend, so that it remains visible


def openusd(*modules: str) -> list[Any]:
    """Import modules of OpenUSD.

    Raises:
        NerfroError: it is not installed.
    """
    return [optional(f"pxr.{name}", "usd", "a .usdz needs usd-core", ", or write a .glb") for name in modules]


def encode_usdz(scene: TrainedScene, glass: list[trimesh.Trimesh], inside: trimesh.Trimesh | None) -> bytes:
    """Encode the surfaces of the bodies, dense content, training cameras and the sky as .usdz.

    The y axis is up, as programs for augmented reality require. Glass has two materials, of which a program takes the
    one that it knows: UsdPreviewSurface is transparent and reflects, and MaterialX's Standard Surface also bends light,
    absorbs and disperses it.
    """
    sdf, usd, geometry, lights, utilities = openusd("Sdf", "Usd", "UsdGeom", "UsdLux", "UsdUtils")
    with tempfile.TemporaryDirectory() as folder:
        stage = usd.Stage.CreateNew(f"{folder}/scene.usdc")
        geometry.SetStageUpAxis(stage, geometry.Tokens.y)
        geometry.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(geometry.Xform.Define(stage, "/scene").GetPrim())
        geometry.Scope.Define(stage, "/scene/materials")
        bodies = scene.renderer.scene.medium.bodies
        materials = [] if bodies is None else bodies.materials
        absorptions = absorption_of(scene.renderer.scene)
        for number, (mesh, absorption, material) in enumerate(zip(glass, absorptions, materials, strict=True)):
            abbe = 0.0 if material.dispersion is None else material.dispersion.abbe
            _add_mesh(stage, f"/scene/glass_{number}", mesh)
            _add_glass(stage, f"/scene/glass_{number}", float(scene.ior[number]), absorption.numpy(), abbe)
        if inside is not None:
            _add_mesh(stage, "/scene/inside", inside)
            _add_emission(stage, "/scene/inside", np.asarray(inside.vertex_attributes["radiance"]))
        _add_cameras(stage, scene.cameras("train").to("cpu"))
        save_lat_long(f"{folder}/sky.exr", scene.sky)
        dome = lights.DomeLight.Define(stage, "/scene/sky")
        dome.CreateTextureFileAttr(sdf.AssetPath("./sky.exr"))
        dome.CreateTextureFormatAttr(lights.Tokens.latlong)
        # The centre of the image is at +x, and that of an unrotated dome at +z.
        dome.AddRotateYOp().Set(90.0)
        stage.GetRootLayer().Save()
        utilities.CreateNewUsdzPackage(sdf.AssetPath(f"{folder}/scene.usdc"), f"{folder}/scene.usdz")
        return Path(folder, "scene.usdz").read_bytes()


def _add_mesh(stage: Any, path: str, mesh: trimesh.Trimesh) -> None:
    geometry, arrays = openusd("UsdGeom", "Vt")
    vertices, normals = (
        (numbers @ Z_UP_TO_Y_UP.T).astype(np.float32) for numbers in (mesh.vertices, mesh.vertex_normals)
    )
    shape = geometry.Mesh.Define(stage, path)
    shape.CreatePointsAttr(arrays.Vec3fArray.FromNumpy(vertices))
    shape.CreateExtentAttr(arrays.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
    shape.CreateFaceVertexCountsAttr(arrays.IntArray(len(mesh.faces), 3))
    shape.CreateFaceVertexIndicesAttr(arrays.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateNormalsAttr(arrays.Vec3fArray.FromNumpy(normals))
    shape.SetNormalsInterpolation(geometry.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(geometry.Tokens.none)


def _add_glass(stage: Any, path: str, ior: float, absorption: np.ndarray, abbe: float) -> None:
    """Give a mesh the materials of glass; an Abbe number of 0 means no dispersion."""
    of_surface: dict[str, Any] = {"base": 0.0, "specular_roughness": 0.0, "specular_IOR": ior, "transmission": 1.0,
                                  "transmission_dispersion": abbe}  # fmt: skip
    if absorption.any():
        depth, colour = attenuation(absorption)
        of_surface |= {"transmission_depth": depth, "transmission_color": colour}
    of_preview = {"ior": ior, "opacity": _OPACITY, "roughness": 0.0, "metallic": 0.0, "diffuseColor": [1.0] * 3}
    _add_material(stage, path, {"": ("UsdPreviewSurface", of_preview),
                                "mtlx": ("ND_standard_surface_surfaceshader", of_surface)})  # fmt: skip


def _add_emission(stage: Any, path: str, radiance: np.ndarray) -> None:
    """Let a mesh emit the radiance of its vertices; a black metal otherwise, which reflects nothing."""
    sdf, geometry, shading, arrays = openusd("Sdf", "UsdGeom", "UsdShade", "Vt")
    mesh = geometry.Mesh(stage.GetPrimAtPath(path))
    mesh.CreateDisplayColorPrimvar(geometry.Tokens.vertex).Set(arrays.Vec3fArray.FromNumpy(radiance.astype(np.float32)))
    preview = {"roughness": 1.0, "metallic": 1.0, "diffuseColor": [0.0] * 3}
    (surface,) = _add_material(stage, path, {"": ("UsdPreviewSurface", preview)})
    reader = shading.Shader.Define(stage, surface.GetPath().ReplaceName("radiance"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", sdf.ValueTypeNames.String).Set("displayColor")
    result = reader.CreateOutput("result", sdf.ValueTypeNames.Float3)
    surface.CreateInput("emissiveColor", sdf.ValueTypeNames.Color3f).ConnectToSource(result)


def _add_material(stage: Any, path: str, shaders: dict[str, tuple[str, dict[str, Any]]]) -> list[Any]:
    """Give a mesh one material with a surface for each render context; returns the shaders."""
    vectors, sdf, shading = openusd("Gf", "Sdf", "UsdShade")
    prim = stage.GetPrimAtPath(path)
    material = shading.Material.Define(stage, f"/scene/materials/{prim.GetName()}")
    made = []
    for context, (name, inputs) in shaders.items():
        made.append(shading.Shader.Define(stage, f"{material.GetPath()}/{context or 'preview'}"))
        made[-1].CreateIdAttr(name)
        for key, value in inputs.items():
            if isinstance(value, float):
                made[-1].CreateInput(key, sdf.ValueTypeNames.Float).Set(value)
            else:
                made[-1].CreateInput(key, sdf.ValueTypeNames.Color3f).Set(vectors.Vec3f(*value))
        output = made[-1].CreateOutput("surface", sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput(*([context] if context else [])).ConnectToSource(output)
    shading.MaterialBindingAPI.Apply(prim).Bind(material)
    return made


def _add_cameras(stage: Any, cameras: Cameras) -> None:
    """Add pinhole cameras, whose axes are those of OpenGL; lens distortion is omitted."""
    vectors, geometry = openusd("Gf", "UsdGeom")
    for view, pose in enumerate(cameras.camera_to_world.double().numpy()):
        camera = geometry.Camera.Define(stage, f"/scene/train_{view:03d}")
        matrix = np.eye(4)
        matrix[:3] = Z_UP_TO_Y_UP @ pose
        camera.AddTransformOp().Set(vectors.Matrix4d(matrix.T.tolist()))  # of row vectors
        pixel = _FILM_WIDTH / cameras.width
        pixel_height = pixel * float(cameras.fx[view] / cameras.fy[view])
        camera.CreateHorizontalApertureAttr(_FILM_WIDTH)
        camera.CreateVerticalApertureAttr(pixel_height * cameras.height)
        camera.CreateFocalLengthAttr(pixel * float(cameras.fx[view]))
        offset = 0.5 * cameras.width - float(cameras.cx[view]), float(cameras.cy[view]) - 0.5 * cameras.height
        camera.CreateHorizontalApertureOffsetAttr(pixel * offset[0])
        camera.CreateVerticalApertureOffsetAttr(pixel_height * offset[1])
        camera.CreateClippingRangeAttr(
            vectors.Vec2f(max(float(cameras.near), 1e-3 * float(cameras.far)), float(cameras.far))
        )
