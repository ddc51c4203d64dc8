// The token that this browser keeps for this address, its port included: no other server is given it.
const given = new URL(location.href).searchParams.get("token");
if (given) {
  localStorage.setItem("token", given);
  history.replaceState(null, "", location.pathname);
}
export const token = () => localStorage.getItem("token") ?? "";
export const keep = (text) => localStorage.setItem("token", text);
export const ask = (path, options = {}) =>
  fetch(path, { ...options, headers: { ...options.headers, Authorization: `Bearer ${token()}` } });
