"""A new format of export is one file and one line of the registry: the page's example."""

from extending.extension import Extension


def test_a_new_format_is_written_by_the_module_and_by_the_command(extension: Extension) -> None:
    printed = extension.printed_by("ros_command")
    folder = extension.folder_of("ros_command")
    assert (folder / "module.sh").read_text() == (folder / "command.sh").read_text()
    help_text = " ".join(printed.split())
    assert "ros_command (.sh): publishes the hand-eye transform in ROS 2." in help_text
