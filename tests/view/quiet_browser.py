"""A browser's side of a page that takes everything and draws nothing, for tests of pages alone."""

import contextlib


class Handle:
    """An input or output: what is set can be read; what a person does comes from the test."""

    def __init__(self, value=None):
        self.value, self.max, self.options, self.content = value, 1.0, (), ""

    def on_update(self, act):
        self.act = act

    on_click = on_update

    def remove(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def add_tab(self, _):
        return Handle()


class Gui:
    """Makes handles and keeps them by their label."""

    def __init__(self):
        self.handles = {}

    def __getattr__(self, kind):
        def add(label, *_, initial_value=None, **__):
            return self.handles.setdefault(label, Handle(initial_value))

        def add_html(content):
            return self.handles.setdefault(f"html {len(self.handles)}", Handle(content))

        return {"add_html": add_html, "add_tab_group": Handle}.get(kind, add)

    def add_slider(self, label, _low, high, _step, value):
        handle = self.handles.setdefault(label, Handle(value))
        handle.max = high
        return handle


class Camera:
    position = look_at = (0.0, 0.0, 0.0)
    fov, image_height = 0.8, 850


class Scene:
    def __getattr__(self, kind):
        return lambda *_, **__: Handle()


class QuietClient:
    def __init__(self):
        self.gui, self.scene, self.camera = Gui(), Scene(), Camera()

    def atomic(self):
        return contextlib.nullcontext()

    def status(self):
        """Return what the page says at its top, "" before it is built."""
        top = self.gui.handles.get("html 0")
        return top.content if top is not None else ""
