"""Imports MuJoCo Studio, which is ``mujoco.studio`` in MuJoCo 4 and part of ``mujoco.experimental`` in MuJoCo 3.17."""

try:
    from mujoco.studio import launch_web, messages, plugin, sim, ux, viewer_protocol, web_viewer
    from mujoco.studio.app import App, Config
    from mujoco.studio.dear_imgui import dear_imgui as imgui
    from mujoco.studio.web import web_server
except ModuleNotFoundError:
    from mujoco.experimental.dear_imgui import dear_imgui as imgui
    from mujoco.experimental.studio import launch_web, messages, plugin, sim, ux, viewer_protocol, web_viewer
    from mujoco.experimental.studio.viewer_app import ViewerApp as App
    from mujoco.experimental.studio.viewer_app import ViewerAppConfig as Config
    from mujoco.experimental.studio.web import web_server

__all__ = [
    "App",
    "Config",
    "imgui",
    "launch_web",
    "messages",
    "plugin",
    "sim",
    "ux",
    "viewer_protocol",
    "web_server",
    "web_viewer",
]
