"""Options of the camera."""

from mwdn.cli.camera import CameraOptions


def test_the_files_of_a_camera_are_read_once(tmp_path):
    """The file was read at each use, so one that changed during a run gave the uses different answers."""
    file = tmp_path / "camera.toml"
    file.write_text('psf = "psf.png"\ndark = "dark.png"\n', encoding="utf-8")
    options = CameraOptions(camera=file)
    before = options.files
    file.write_text('psf = "other.png"\n', encoding="utf-8")
    assert options.files == before == (file, tmp_path / "psf.png", tmp_path / "dark.png")
