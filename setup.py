"""Puts the configurations of the repository's `configs/` into the package as `tofcorr/configs/`."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

CONFIGS = Path("configs")


class BuildWithConfigs(build_py):
    """Copies `configs/` into the built package; an editable install reads it where it stands."""

    def run(self) -> None:
        """Build the modules, then copy the configurations beside them."""
        super().run()
        if self.editable_mode:
            return
        for source, target in self._configs().items():
            self.mkpath(str(Path(target).parent))
            self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        """Return the files built; installers record them."""
        outputs = super().get_outputs(include_bytecode)
        return outputs if self.editable_mode else [*outputs, *self._configs().values()]

    def get_source_files(self) -> list[str]:
        """Return the files that a source distribution needs."""
        return [*super().get_source_files(), *self._configs()]

    def _configs(self) -> dict[str, str]:
        """Return the file in the built package for each file of the repository."""
        package = Path(self.build_lib or ".") / "tofcorr"
        return {str(file): str(package / file) for file in sorted(CONFIGS.glob("*/*.yaml"))}


setup(cmdclass={"build_py": BuildWithConfigs})
