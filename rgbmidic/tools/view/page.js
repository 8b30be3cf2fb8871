// What the browser does by itself; the functions are called by `widgets.script` with parts of the page.
const rgbmidic = {
  next: 0,

  // Ask for the frame of the slider, one at a time; while frames are played, for the next one at least `wait` ms later.
  pump({state, slider, play, step, wait}) {
    if (state.requested_frame !== state.displayed_frame) return;
    if (slider.value !== state.displayed_frame) { state.requested_frame = slider.value; return; }
    if (!play.active) return;
    setTimeout(() => {
      if (!play.active || slider.value !== state.displayed_frame) return;
      rgbmidic.next = performance.now() + wait;
      slider.value = slider.value + step.value > slider.end ? slider.start : slider.value + step.value;
    }, Math.max(0, rgbmidic.next - performance.now()));
  },

  // Mark the frame that is shown in the time line, and keep the view in the address.
  showFrame({state, now}) {
    now.setv({location: state.displayed_frame}, {sync: false});
    const path = new URL(location.href).searchParams.get("path");
    const kept = path === null ? "?" : "?path=" + encodeURIComponent(path) + "&";
    history.replaceState(null, "", kept + "frame=" + state.displayed_frame + (state.query && "&" + state.query));
  },

  // Take the tool of the button that was pressed; of two groups of buttons one is pressed.
  choose({group, tools, other}) {
    if (group.active === null) return;
    tools[group.active].active = true;
    if (other) other.active = null;
  },

  // Show one of the sections of the controls.
  turnTo({group, sections}) {
    sections.forEach((one, place) => { one.visible = place === group.active; });
    setTimeout(rgbmidic.label, 200);
  },

  // Say what each input is for, to screen readers: checkboxes, sliders and numbers without a title do not.
  label() {
    for (const model of Bokeh.documents[0]._all_models.values()) {
      const text = model.title || model.label || model.html_attributes?.["aria-label"];
      if (typeof text !== "string") continue;
      try {
        Bokeh.index.get_one(model).shadow_el.querySelectorAll("input, [role=slider]").forEach((one) => {
          if (!one.labels?.[0]?.textContent.trim()) one.ariaLabel = text;
        });
      } catch { /* it is on no page */ }
    }
  },

  // While a curve can be dragged the plot itself stays where it is.
  hold({toggle, pan}) {
    pan.active = !toggle.active;
  },

  turn({theme}) {
    const address = new URL(location.href);
    address.searchParams.set("theme", theme);
    location.replace(address.href);
  },

  keep(blob, name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    URL.revokeObjectURL(link.href);
  },

  keepCsv({state}) {
    if (!state.csv) return;
    rgbmidic.keep(new Blob([state.csv], {type: "text/csv"}), "history.csv");
    state.csv = "";
  },

  keepPng({state}) {
    if (!state.png) return;
    const end = state.png.indexOf(" "), name = state.png.slice(end + 1);  // which may have spaces itself
    fetch(state.png.slice(0, end)).then((answer) => answer.blob()).then((blob) => rgbmidic.keep(blob, name));
    state.png = "";
  },
};
window.rgbmidic = rgbmidic;
const waiting = setInterval(() => {
  if (!Bokeh.documents[0]?.is_idle) return;
  clearInterval(waiting);
  rgbmidic.label();
}, 200);

// Keys: a frame back and forth, first and last, play; the page is asked for one frame at a time (`pump`).
document.addEventListener("keydown", (event) => {
  const target = event.composedPath()[0];
  const writing = target.tagName === "SELECT" || (target.tagName === "INPUT" && target.type !== "range");
  const page = Bokeh.documents[0];
  const back = !event.shiftKey && event.key === "z", again = event.key === "y" || (event.shiftKey && event.key === "Z");
  if (page && !writing && (event.ctrlKey || event.metaKey) && (back || again)) {
    const button = page.get_model_by_name(back ? "undo" : "redo");
    if (button) Bokeh.index.get_one(button).el.shadowRoot.querySelector("button").click();
    event.preventDefault();
  }
  if (writing || event.ctrlKey || event.altKey || event.metaKey || !page) return;
  const slider = page.get_model_by_name("frame"), play = page.get_model_by_name("play");
  const step = page.get_model_by_name("step").value || 1;
  const to = {
    ArrowRight: slider.value + step, ArrowLeft: slider.value - step,
    PageDown: slider.value + 10 * step, PageUp: slider.value - 10 * step,
    Home: slider.start, End: slider.end,
  }[event.key];
  const movie = page.get_model_by_name("movie");
  const section = page.get_model_by_name("section"), asked = Number(event.key) - 1;
  if (section && section.labels[asked]) section.active = asked; else
  if (to !== undefined) slider.value = Math.min(Math.max(to, slider.start), slider.end);
  else if (event.key === " ") play.active = !play.active;
  else if (event.key === "m" && movie) movie.active = !movie.active;
  else return;
  event.preventDefault();
  event.stopPropagation();
}, true);
