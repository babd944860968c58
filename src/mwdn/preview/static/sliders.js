// Options of a method as sliders: a range of decades is logarithmic. Each can return to the method's default.

let current = [];

const format = (value) => (value === null ? "automatic" : Number(value.toPrecision(3)).toString());

export function drawSliders(place, options, changed, values = {}) {
  const shown = options.filter(({ low }) => low !== null).map((option) => makeSlider(option, changed, values));
  current = shown.map(({ state }) => state);
  place.replaceChildren(...shown.flatMap(({ parts }) => parts));
}

function makeSlider(option, changed, values) {
  const logarithmic = option.high / option.low > 1000;
  const [to, from] = logarithmic ? [Math.log10, (x) => 10 ** x] : [(x) => x, Math.round];
  const id = `option-${option.name}`;
  const label = Object.assign(document.createElement("label"), { htmlFor: id, title: option.about });
  const output = document.createElement("output");
  label.append(`${option.name} `, output);
  const slider = Object.assign(document.createElement("input"), {
    id, type: "range", min: to(option.low), max: to(option.high), step: logarithmic ? "any" : 1,
  });
  const back = Object.assign(document.createElement("button"), {
    id: `${id}-reset`, type: "button", className: "reset", textContent: `Reset to ${format(option.default)}`,
  });
  back.setAttribute("aria-label", `${back.textContent}: ${option.name}`);
  const state = { name: option.name };
  const set = (value, isSet) => {
    Object.assign(state, { value, isSet });
    output.textContent = format(value);
    slider.setAttribute("aria-valuetext", output.textContent);
    back.hidden = !isSet;
  };
  const show = (value, isSet) => {
    slider.value = to(value ?? (logarithmic ? Math.sqrt(option.low * option.high) : option.low));
    set(value, isSet);
  };
  slider.oninput = () => {
    set(from(Number(slider.value)), true);
    changed();
  };
  back.onclick = () => {
    slider.focus(); // the button vanishes
    show(option.default, false);
    changed();
  };
  const isSet = option.name in values;
  show(isSet ? values[option.name] : option.default, isSet);
  return { state, parts: [label, slider, back] };
}

export function readSliders() {
  return Object.fromEntries(current.filter(({ isSet }) => isSet).map(({ name, value }) => [name, value]));
}
