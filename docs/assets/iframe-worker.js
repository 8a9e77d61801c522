// A Worker for pages that were opened from a folder, where browsers refuse real ones: a script in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.ready = new Promise((resolve) => {
        const frame = document.createElement("iframe");
        frame.hidden = true;
        document.body.append(frame);
        const inner = frame.contentWindow;
        const add = (source) => new Promise((loaded) => {
          const script = inner.document.createElement("script");
          script.src = source;
          script.onload = script.onerror = loaded;
          inner.document.head.append(script);
        });
        inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
        inner.importScripts = (...sources) => sources.reduce((done, source) => done.then(() => add(source)), Promise.resolve());
        add(url).then(() => resolve(inner));
      });
    }
    postMessage(data) {
      this.ready.then((inner) => inner.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {}
  };
}
