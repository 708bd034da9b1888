"""The documentation site opens its pictures in full size."""

from studies.full_size_pictures import on_page_content


def test_a_picture_is_a_link_to_itself() -> None:
    picture = '<img alt="A" src="figures/a.svg" />'
    assert on_page_content(f"<p>{picture}</p>") == (
        f'<p><a href="figures/a.svg" title="Open in full size">{picture}</a></p>'
    )
