def render(sources, judged):
    return "<p></p>"
