// Keys: a frame back and forth, first and last, play; the page is asked for one frame at a time (see `models.PUMP`).
document.addEventListener("keydown", (event) => {
  const target = event.composedPath()[0];
  const writing = target.tagName === "SELECT" || (target.tagName === "INPUT" && target.type !== "range");
  const page = Bokeh.documents[0];
  if (writing || event.ctrlKey || event.altKey || event.metaKey || !page) return;
  const slider = page.get_model_by_name("frame"), play = page.get_model_by_name("play");
  const step = page.get_model_by_name("step").value || 1;
  const to = {
    ArrowRight: slider.value + step, ArrowLeft: slider.value - step,
    PageDown: slider.value + 10 * step, PageUp: slider.value - 10 * step,
    Home: slider.start, End: slider.end,
  }[event.key];
  if (to !== undefined) slider.value = Math.min(Math.max(to, slider.start), slider.end);
  else if (event.key === " ") play.active = !play.active;
  else return;
  event.preventDefault();
  event.stopPropagation();
}, true);
