"""Draw `docs/demo.png` anew, the upper part of the page that `sealscope demo` writes: python docs/draw_demo.py."""

from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from sealscope.demo import run_demo
from sealscope.reporting.printing import draw_page

#: Size of the picture in pixels; it ends below the drawing of the actuator.
WIDTH, HEIGHT = 940, 1556

with TemporaryDirectory() as folder:
    page = run_demo(Path(folder)).page.read_text(encoding="utf-8")
picture = Path(__file__).with_name("demo.png")
draw_page(page, picture, WIDTH, HEIGHT)
Image.open(picture).quantize(256).save(picture, optimize=True)
